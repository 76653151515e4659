"""Options by which a verb takes a reader or a writer of the user's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

    verb = "Reads" if kind == "reader" else "Writes"
    return click.option(
        f"--{kind}",
        metavar="FILE.py:NAME",
        multiple=True,
        expose_value=False,
        callback=use,
        help=f"{verb} files of a kind of your own; repeatable.",
    )
