"""What every node of a configuration is, and what every constant of its expert part says of itself."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

BY_HAND = "set by hand, never varied"
"""Source of a constant that nobody has measured."""


class Section(BaseModel):
    """A node of the configuration tree: frozen, strict about keys, lenient about 1 against 1.0."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _of_its_own(cls, tree: Any) -> Any:
        """A key of a section inside this one leaves that section's others as they stand here by default; true and
        false are no numbers."""
        if not isinstance(tree, dict):
            return tree
        whole = dict(tree)
        for name, info in cls.model_fields.items():
            given, default = whole.get(name), info.default
            if isinstance(given, dict) and isinstance(default, Section):
                whole[name] = {key: getattr(default, key) for key in default.model_fields_set} | given
            elif {int, float} & (kinds := _kinds(info.annotation)) and bool not in kinds:
                whole.update({name: _in_words(given)} if name in whole else {})
        return whole

    def __hash__(self) -> int:
        """Of the values; options of parts are mappings, which have no hash of their own."""
        return hash(self.model_dump_json())


def _kinds(annotation: Any) -> set[Any]:
    """The types that an annotation is made of."""
    return {annotation}.union(*(_kinds(part) for part in get_args(annotation)))


def _in_words(value: Any) -> Any:
    """A value whose truths are words, which no number is read from; Python takes true for 1."""
    if isinstance(value, (list, tuple)):
        return [_in_words(one) for one in value]
    return str(value).lower() if isinstance(value, bool) else value


def constant(
    default: Any, unit: str, limits: tuple[float, float] | None, text: str, source: str = BY_HAND
) -> Any:
    """A field of an expert section.

    Args:
        default: its value.
        unit: such as "voxels"; "-" for a bare number.
        limits: least and most that it may be; None for tuples, whose members carry their own.
        text: what it means.
        source: where the value comes from: a fit, a measurement, a paper, or `BY_HAND`.
    """
    least, most = limits or (None, None)
    return Field(
        default, ge=least, le=most, description=text, json_schema_extra={"unit": unit, "source": source}
    )
