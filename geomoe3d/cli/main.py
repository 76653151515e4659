"""The two commands: ``geomoe3d VERB`` and ``register``, which is ``geomoe3d register``.

A verb's file is read only when its name or the help is asked for, and imports the library only when it
runs, so that help answers at once.
"""

from __future__ import annotations

import difflib
import sys
from importlib import import_module

import click

from geomoe3d import __version__
from geomoe3d.cli.errors import HELP, run

VERBS = (
    "register",
    "batch",
    "multiway",
    "pose",
    "homography",
    "index",
    "locate",
    "evaluate",
    "train",
    "data",
    "sample",
    "config",
    "doctor",
)
"""In the order of the help; each has its file ``geomoe3d/cli/<verb>.py`` with a ``command``."""


class _Verbs(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in VERBS:
            return None
        command: click.Command = import_module(f"geomoe3d.cli.{name}").command
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name not in VERBS and not name.startswith("-"):
            close = difflib.get_close_matches(name, VERBS, n=1)
            hint = f"did you mean '{close[0]}'?" if close else f"there are: {', '.join(VERBS)}"
            ctx.fail(f"there is no command '{name}'; {hint}")
        return super().resolve_command(ctx, args)


@click.group(cls=_Verbs, context_settings=HELP)
@click.version_option(__version__, prog_name="geomoe3d")
def geomoe3d() -> None:
    """Point cloud registration: two scans in, the rigid transform out, and how sure it is.

    Exit codes: 0 done and sure; 1 a fault of the program; 2 the input, an option or the machine is at
    fault; 3 done, but not sure of the answer; 130 interrupted.
    """


def main() -> None:
    """Entry point of ``geomoe3d``."""
    sys.exit(run(geomoe3d, "geomoe3d"))


def register_main() -> None:
    """Entry point of ``register``, the same as ``geomoe3d register``."""
    from geomoe3d.cli.register import command

    sys.exit(run(command, "register"))


if __name__ == "__main__":
    main()
