"""A configuration as commented YAML, written from the descriptions and limits in its classes.

One source for `geomoe3d config` and configs/default.yaml; what it writes, `load_config` reads back.
"""

from __future__ import annotations

import textwrap
from typing import Any, Literal, Union, get_args, get_origin

import yaml

from geomoe3d.config import ExpertConfig, Section

_LIMITS = (("ge", "at least {}"), ("gt", "above {}"), ("le", "at most {}"), ("lt", "below {}"))


def commented_yaml(config: Section, *, expert: bool = False) -> str:
    """The whole tree, a comment of meaning, choices and limits above each value.

    ``expert``: with all constants for experts; else with those that are not at their defaults.
    """
    return "\n".join([*_comment(type(config).__doc__ or "", ""), "", *_section(config, "", expert)]) + "\n"


def _section(section: Section, indent: str, expert: bool, among_constants: bool = False) -> list[str]:
    lines: list[str] = []
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        constants = among_constants or isinstance(value, ExpertConfig)
        if constants and not expert and value == getattr(type(section)(), name):
            continue
        if isinstance(value, Section):
            lines += ["", *_comment(type(value).__doc__ or "", indent), f"{indent}{name}:"]
            lines += _section(value, indent + "  ", expert, constants)
            continue
        limits = _limits(info.metadata) + _limits_inside(info.annotation)
        about = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
        unit, source = (f"{about[key]}" if about.get(key, "-") != "-" else "" for key in ("unit", "source"))
        parts = [unit, info.description or "", _choices(info.annotation), ", ".join(limits), source]
        lines += _comment("; ".join(part for part in parts if part), indent)
        lines.append(f"{indent}{name}: {_scalar(value)}")
    return lines


def _comment(text: str, indent: str) -> list[str]:
    text = " ".join(text.split())
    return textwrap.wrap(text, 96, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _scalar(value: Any) -> str:
    if hasattr(value, "tolist"):
        value = value.tolist()
    flow = yaml.safe_dump(value, default_flow_style=True, width=10_000)
    return flow.removesuffix("\n").removesuffix("\n...")


def _choices(annotation: Any) -> str:
    if get_origin(annotation) is Literal:
        return "one of " + ", ".join(map(str, get_args(annotation)))
    return ""


def _limits(metadata: list[Any]) -> list[str]:
    found = []
    for name, words in _LIMITS:
        for constraint in metadata:
            if getattr(constraint, name, None) is not None:
                found.append(words.format(getattr(constraint, name)))
    return found


def _limits_inside(annotation: Any) -> list[str]:
    """Limits of the members of a union, such as `Annotated[float, gt=0] | None`."""
    if get_origin(annotation) is not Union:
        return []
    return [limit for member in get_args(annotation) for limit in _limits(list(get_args(member)[1:]))]
