"""Options for readers and writers of the user's own, and the check of output files that verbs share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from geomoe3d.clouds.formats.registry import Kind

Command = TypeVar("Command", bound=Callable[..., Any])


def part_option(kind: Kind) -> Callable[[Command], Command]:
    """Adds ``--reader`` or ``--writer``; the verb itself need not know of it."""

    def use(context: click.Context, parameter: click.Parameter, specs: Sequence[str]) -> None:
        if specs:
            from geomoe3d.clouds.io import use_part

            for spec in specs:
                use_part(kind, spec)

    verb = "reads" if kind == "reader" else "writes"
    return click.option(
        f"--{kind}",
        metavar="FILE.py:NAME",
        multiple=True,
        expose_value=False,
        callback=use,
        help=f"Python code of yours that {verb} further kinds of files; repeatable.",
    )


def is_map(name: str) -> bool:
    """Whether an argument names what `geomoe3d index` writes."""
    return Path(name).suffix.lower() == ".map"


def check_outputs(
    wanted: Iterable[tuple[str, str | None, tuple[str, ...]]], inputs: Iterable[str], force: bool
) -> None:
    """Refuse, before the work begins, every output file that has to be refused at all.

    Args:
        wanted: option, its file (None: not asked for), and the suffixes that it may have (none: any).
        inputs: files that are read: none of them is ever written over, ``--force`` or not.
        force: files that exist may be replaced.

    Raises:
        FormatError: a suffix that cannot be written.
        OutputError: a file that cannot be written, that exists without ``force``, or that is named twice.
    """
    from geomoe3d.clouds.transform_files import check_suffix
    from geomoe3d.errors import OutputError
    from geomoe3d.runtime.files import check_output

    taken = {Path(path).resolve(): "an input" for path in inputs}
    for option, path, suffixes in wanted:
        if path is None:
            continue
        if suffixes:
            check_suffix(path, suffixes)
        check_output(path, force=force)
        owner = taken.get(Path(path).resolve())
        if owner is not None:
            raise OutputError(f"{option} '{path}' is also {owner}; give another name")
        taken[Path(path).resolve()] = option
