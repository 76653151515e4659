"""The inventory of public names with their types: what changes here changes for users.

After a wanted change: ``python tests/test_public_api.py`` writes the file anew; say it in CHANGELOG.md.
"""

from __future__ import annotations

import inspect
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import GenericAlias

import geomoe3d

INVENTORY = Path(__file__).with_name("public_api.txt")


def entries():
    """One line per public name, and per public member of a class."""
    for name in sorted(geomoe3d.__all__):
        value = getattr(geomoe3d, name)
        if inspect.isfunction(value):
            yield f"{name}{inspect.signature(value)}"
        elif inspect.isclass(value):
            bases = ", ".join(base.__name__ for base in value.__bases__)
            yield f"class {name}({bases})"
            yield from (f"  {member}" for member in sorted(members(value)))
        else:
            yield f"{name}: {type(value).__name__}"


def members(kind):
    if is_dataclass(kind):
        for field in fields(kind):
            yield f"{field.name}: {field.type}"
    elif hasattr(kind, "model_fields"):
        for name, field in kind.model_fields.items():
            shown = field.annotation
            plain = isinstance(shown, type) and not isinstance(shown, GenericAlias)
            yield f"{name}: {shown.__name__ if plain else shown}"
    elif kind.__init__ is not object.__init__ and not issubclass(kind, Exception):
        yield f"__init__{inspect.signature(kind.__init__)}"
    for name, value in vars(kind).items():
        if name.startswith("_") or name == "model_config":
            continue
        if isinstance(value, property):
            yield f"{name} -> {value.fget.__annotations__['return']}"
        elif isinstance(value, classmethod) or inspect.isfunction(value):
            yield f"{name}{inspect.signature(getattr(value, '__func__', value))}"


def test_the_public_names_and_types_are_those_of_the_inventory():
    assert list(entries()) == INVENTORY.read_text().splitlines(), "run: python tests/test_public_api.py"


def test_every_public_function_is_typed():
    for line in entries():
        if "(" in line and not line.startswith("class "):
            assert "->" in line, line


if __name__ == "__main__":
    INVENTORY.write_text("\n".join(entries()) + "\n")
