"""``geomoe3d config``: the complete configuration, with what each key means."""

from __future__ import annotations

import click

from geomoe3d.cli.errors import HELP, Verb, renamed, traceback_option


@click.command(cls=Verb, context_settings=HELP, short_help="Print the complete configuration, commented.")
@click.option("--config", "source", metavar="FILE", help="Start from this YAML file.")
@click.option("--set", "assignments", metavar="KEY=VALUE", multiple=True, help="Change one value.")
@click.option(
    "--all", "expert", is_flag=True, help="With the constants for experts, their units and sources."
)
@click.option("--output", metavar="FILE", help="Write to this file instead of the screen.")
@click.option("--force", is_flag=True, help="Replace a file that exists.")
@renamed("--out", "--output")
@traceback_option
def command(
    source: str | None, assignments: tuple[str, ...], expert: bool, output: str | None, force: bool
) -> None:
    """Print the complete configuration of `register` as commented YAML.

    Edit it and pass it on with `register --config FILE`; keys left out keep their defaults. Without --all, constants
    for experts are printed only where they were changed.
    """
    from geomoe3d.config import load_config
    from geomoe3d.runtime.config_text import commented_yaml
    from geomoe3d.runtime.files import write_text

    text = commented_yaml(load_config(source, list(assignments)), expert=expert)
    if output is None:
        click.echo(text, nl=False)
        return
    write_text(output, text, force=force)
    click.echo(output)
