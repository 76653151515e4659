"""From exceptions to messages and exit codes; the one place where a command ends.

0 done and sure; 1 a fault of the program; 2 the input, an option or the machine is at fault; 3 done, but
not sure of the answer; 130 interrupted; 141 the reader of stdout went away (as a signal SIGPIPE gives).
"""

from __future__ import annotations

import os
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, TypeVar

import click

from geomoe3d.errors import GeoMoE3DError
from geomoe3d.runtime.home import ensure_home


class ExitCode(IntEnum):
    """How a verb ended."""

    OK = 0
    FAULT = 1
    BAD_INPUT = 2
    NOT_SURE = 3
    INTERRUPTED = 130
    PIPE_CLOSED = 141


HELP = {"help_option_names": ["-h", "--help"]}
"""Click's settings of every command."""

_FOR_EXPERTS = {
    *("part_descriptor", "part_matcher", "part_filter", "part_estimator", "part_refiner", "part_scorers"),
    *("assignments", "config_file", "weights", "correspondences", "seed", "cache", "no_cache", "scheduler"),
    *("reader", "writer", "traceback", "optimizer"),
}
"""Parameters that one can do without knowing."""


class Verb(click.Command):
    """A verb in whose help the options for experts stand apart, behind the others.

    What fills a folder takes it as OUT, the last argument; single files go where ``--output`` says. Who writes the one
    for the other is told which it is here.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """As click, but for what is said of OUT and ``--output``."""
        words = " ".join(self.collect_usage_pieces(ctx)[1:]).split()
        names = {name for option in self.params for name in option.opts}
        try:
            left = super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if error.option_name in ("--output", "--out", "-o") and words and "OUT" in words[-1]:
                said = f"{error.option_name} is not an option here: {words[-1]} is the last argument"
                raise click.UsageError(f"{said}, as in '{ctx.command_path} {' '.join(words)}'", ctx) from None
            raise
        except click.UsageError as error:
            if "unexpected extra argument" in error.message and "--output" in names:
                said = f"{error.message}; the file to write is given by --output"
                raise click.UsageError(said, ctx) from None
            raise
        for argument in self.params:
            given = ctx.params.get(str(argument.name)) if isinstance(argument, click.Argument) else None
            if given == "" or (isinstance(given, tuple) and "" in given):
                name = argument.make_metavar(ctx)
                said = (
                    f"an empty name is given for {name}; it would mean the folder where you are, which is '.'"
                )
                raise click.UsageError(said, ctx)
        return left

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Both kinds, each in the order in which they were declared."""
        rows: dict[str, list[tuple[str, str]]] = {"Options": [], "Options for experts": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx) if isinstance(parameter, click.Option) else None
            if record is not None:
                kind = "Options for experts" if parameter.name in _FOR_EXPERTS else "Options"
                rows[kind].append(record)
        for title, records in rows.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


_TRACEBACK = "geomoe3d.traceback"
_COMMAND = "geomoe3d.command"

F = TypeVar("F", bound=Callable[..., Any])


def run(command: click.Command, name: str, arguments: Sequence[str] | None = None) -> int:
    """Run a command to its exit code; never raises, never shows a traceback that nobody asked for.

    Args:
        command: a verb or the group of verbs.
        name: what the user typed, for the usage line.
        arguments: None takes those of the process.
    """
    completing = os.environ.get(f"_{name.upper()}_COMPLETE")
    if completing:
        from click.shell_completion import shell_complete

        return shell_complete(command, {}, name, f"_{name.upper()}_COMPLETE", completing)
    ensure_home()
    warnings.showwarning = _say_warning
    words = list(sys.argv[1:] if arguments is None else arguments)
    wanted: dict[str, Any] = {
        _TRACEBACK: os.environ.get("GEOMOE3D_TRACEBACK", "") not in ("", "0"),
        _COMMAND: shlex.join([name, *words]),
    }
    try:
        try:
            context = command.make_context(name, list(words))
            context.meta.update({**wanted, **context.meta})
            wanted = context.meta  # shared with the contexts of the verbs
            with context:
                command.invoke(context)
            code: int = ExitCode.OK
        except click.exceptions.Exit as stop:
            code = stop.exit_code
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # What Python still holds for stdout must go nowhere, or it complains on its way out.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return ExitCode.PIPE_CLOSED
    except (KeyboardInterrupt, click.Abort):
        click.echo("interrupted", err=True)
        return ExitCode.INTERRUPTED
    except click.ClickException as error:
        error.show()
        return ExitCode.BAD_INPUT
    except Exception as error:
        if wanted[_TRACEBACK]:
            traceback.print_exc()
        return _explain(error, bool(wanted[_TRACEBACK]))


def _say_warning(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
    """A warning in plain words, without the place in the program that gave it."""
    click.echo(f"warning: {message}", err=True)


def command_line() -> str:
    """The command at work as the user typed it, for the record in what it writes."""
    return str(click.get_current_context().meta[_COMMAND])


def _explain(error: Exception, shown: bool) -> int:
    if isinstance(error, GeoMoE3DError):
        click.echo(f"error: {error}", err=True)
        return ExitCode.BAD_INPUT
    if isinstance(error, MemoryError):
        message = "out of memory; a larger --voxel-size needs less"
    else:
        text = " ".join(str(error).split())
        message = f"internal error: {type(error).__name__}{': ' if text else ''}{text}"
    hint = "" if shown else "; --traceback (or GEOMOE3D_TRACEBACK=1) shows where"
    click.echo(f"{message}\nThis is a fault of geomoe3d, not of your input{hint}.", err=True)
    return ExitCode.FAULT


def use_instead(said: str, *words: str, verb: str | None = None) -> click.UsageError:
    """An error that ends in the line to type.

    Args:
        said: what is wrong.
        words: arguments of the verb at work, in the right order.
        verb: another verb in its place.
    """
    context = click.get_current_context()
    command = context.command_path if verb is None else f"{context.find_root().command_path} {verb}"
    return click.UsageError(f"{said}; write '{command} {shlex.join(words)}'")


def renamed(old: str, new: str) -> Callable[[F], F]:
    """Gives a verb the old name of an option, whose use is an error that names the new one."""

    def refuse(context: click.Context, parameter: click.Parameter, value: str | None) -> None:
        if value is not None:
            raise click.UsageError(f"{old} is now {new}", context)

    # Without a value too: what the old name took does not matter.
    return click.option(old, hidden=True, expose_value=False, is_flag=False, flag_value="", callback=refuse)


def renamed_verb(group: click.Group, old: str, new: str) -> None:
    """Gives a group the old name of a verb, whose use is an error that names the new one."""

    @group.command(old, hidden=True, add_help_option=False, context_settings={"ignore_unknown_options": True})
    @click.argument("words", nargs=-1, type=click.UNPROCESSED)
    @click.pass_context
    def refuse(context: click.Context, words: tuple[str, ...]) -> None:
        room = context.command_path.removesuffix(old).split()[-1]
        raise click.UsageError(f"'{room} {old}' is now '{room} {new}'", context.parent)


def refuse_bare_settings(words: tuple[str, ...]) -> None:
    """Where settings were once given without ``--set``: an error that says how they are given now."""
    if words:
        raise click.UsageError(f"write --set {words[0]}, not {words[0]} alone")


def traceback_option(function: F) -> F:
    """Gives a verb the option ``--traceback``."""

    def remember(context: click.Context, parameter: click.Parameter, value: bool) -> None:
        if value:
            context.meta[_TRACEBACK] = True

    return click.option(
        "--traceback",
        is_flag=True,
        expose_value=False,
        callback=remember,
        help="Show where in the program an error arose.",
    )(function)
