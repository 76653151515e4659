"""What every node of a configuration is, and what every constant of its expert part says of itself."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

BY_HAND = "set by hand, never varied"
"""Source of a constant that nobody has measured."""


class Section(BaseModel):
    """A node of the configuration tree: frozen, strict about keys, lenient about 1 against 1.0."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _of_its_own(cls, tree: Any) -> Any:
        """A key of a section inside this one leaves that section's others as they stand here by default."""
        if not isinstance(tree, dict):
            return tree
        whole = dict(tree)
        for name, info in cls.model_fields.items():
            given, default = whole.get(name), info.default
            if isinstance(given, dict) and isinstance(default, Section):
                whole[name] = {key: getattr(default, key) for key in default.model_fields_set} | given
        return whole

    def __hash__(self) -> int:
        """Of the values; options of parts are mappings, which have no hash of their own."""
        return hash(self.model_dump_json())


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
