"""``geomoe3d doctor``: what is missing on this machine."""

from __future__ import annotations

import json

import click

from geomoe3d.cli.errors import HELP, ExitCode, Verb, traceback_option

_COLORS = {"ok": "green", "missing": "yellow", "broken": "red"}


@click.command(cls=Verb, context_settings=HELP, short_help="Check the installation and say how to repair it.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@traceback_option
@click.pass_context
def command(context: click.Context, as_json: bool) -> None:
    """Check the installation and print the commands that repair it.

    Exit code 0 when everything required is there, else 2.
    """
    from geomoe3d import doctor

    findings = doctor.examine()
    if as_json:
        click.echo(json.dumps(doctor.as_json(findings), indent=2))
    else:
        click.echo(doctor.report(findings, lambda text, state: click.style(text, fg=_COLORS[state])))
    context.exit(0 if doctor.is_healthy(findings) else ExitCode.BAD_INPUT)
