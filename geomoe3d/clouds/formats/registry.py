"""Which function reads or writes which suffix. A reader or writer joins with one decorator.

A reader is called with a path and gives a `RawCloud`, or anything else in memory that `load_points` takes. A
writer is called with a binary file open for writing and a `RawCloud`, and gives the names of what of it the
format cannot hold. Both are functions, or classes whose objects are called so. Readers raise `FormatError`
for bad files.

A user's own join by their name, ``file.py:name`` or ``package.module:name``: by `use_part`, or by the
variables ``GEOMOE3D_READER`` and ``GEOMOE3D_WRITER`` (several with semicolons between), which worker processes
inherit.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, TypeVar

from geomoe3d.errors import ConfigError

Reader = Callable[[Path], Any]
Writer = Callable[..., Iterable[str]]  # of a BinaryIO and a RawCloud
Kind = Literal["reader", "writer"]
Part = TypeVar("Part", bound=Callable[..., Any])

READERS: dict[str, Reader] = {}
CLOUD_WRITERS: dict[str, Writer] = {}
MESH_WRITERS: dict[str, Writer] = {}
VARIABLES: dict[Kind, str] = {"reader": "GEOMOE3D_READER", "writer": "GEOMOE3D_WRITER"}
_FORMATS = "_geomoe3d_formats"  # where the decorators note on a part what it is for
_taken: set[tuple[Kind, str]] = set()


def reader(*suffixes: str) -> Callable[[Part], Part]:
    """Make a function or a class the reader of files with these suffixes, lower case with dot."""
    return lambda part: _join(part, READERS, suffixes)


def writer(*suffixes: str, mesh: bool = False) -> Callable[[Part], Part]:
    """Make a function or a class the writer of files with these suffixes, lower case with dot.

    Args:
        suffixes: as given for output files.
        mesh: it writes triangles and is not asked for clouds without.
    """
    return lambda part: _join(part, MESH_WRITERS if mesh else CLOUD_WRITERS, suffixes)


def _join(part: Part, table: dict[str, Any], suffixes: tuple[str, ...]) -> Part:
    called = part() if isinstance(part, type) else part
    table.update(dict.fromkeys(suffixes, called))
    setattr(part, _FORMATS, [*getattr(part, _FORMATS, []), (table, suffixes)])
    return part


def use_part(kind: Kind, spec: str) -> None:
    """Take a reader or writer of the user's own, in this process and in those that it starts.

    Args:
        kind: which of the two.
        spec: ``file.py:name`` or ``package.module:name`` of what `reader` or `writer` decorates. It is asked
            for all files with its suffixes, in place of ours.

    Raises:
        ConfigError: there is no such thing, or it is not decorated so.
    """
    from geomoe3d.parts import load_object

    place, _, name = spec.rpartition(":")
    spec = f"{Path(place).resolve()}:{name}" if place.endswith(".py") else spec
    part = load_object(spec, f"a {kind}")
    tables = (READERS,) if kind == "reader" else (CLOUD_WRITERS, MESH_WRITERS)
    formats = [found for found in getattr(part, _FORMATS, []) if any(found[0] is table for table in tables)]
    if not formats:
        raise ConfigError(
            f"'{spec}' does not say which files it is for; decorate it with {kind}('.suffix') of {__name__}"
        )
    for table, suffixes in formats:
        table.update(dict.fromkeys(suffixes, part() if isinstance(part, type) else part))
    _taken.add((kind, spec))
    known = [one for one in os.environ.get(VARIABLES[kind], "").split(";") if one]
    os.environ[VARIABLES[kind]] = ";".join(dict.fromkeys([*known, spec]))


def own_readers() -> dict[str, dict[str, str]]:
    """By suffix, who reads it in place of ours: its name and a hash of its code."""
    from geomoe3d.runtime.sources import source_hash

    take_inherited()
    found: dict[str, dict[str, str]] = {}
    for suffix, part in READERS.items():
        kind = part if hasattr(part, "__qualname__") else type(part)
        if not kind.__module__.startswith("geomoe3d."):
            name = f"{kind.__module__.rpartition('.')[2]}:{kind.__qualname__}"
            found[suffix] = {"reader": name, "code": source_hash(kind.__module__)}
    return found


def reader_names() -> tuple[str, ...]:
    """The names under which `use_part` took them, so that workers elsewhere can take them too."""
    return tuple(one for one in os.environ.get(VARIABLES["reader"], "").split(";") if one)


def take_inherited() -> None:
    """Take the parts that the variables name, those of a parent process among them."""
    for kind, variable in VARIABLES.items():
        for spec in os.environ.get(variable, "").split(";"):
            if spec and (kind, spec) not in _taken:
                _taken.add((kind, spec))
                use_part(kind, spec)
