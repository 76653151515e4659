"""``geomoe3d sample``: write the generated sample pair."""

from __future__ import annotations

import click

from geomoe3d.cli.errors import HELP, Verb, traceback_option
from geomoe3d.cli.parts import Number


@click.command(cls=Verb, context_settings=HELP)
@click.argument("folder", default="sample", metavar="[FOLDER]")
@click.option(
    "--seed",
    metavar="N",
    type=Number(0),
    default=0,
    show_default=True,
    help="Random seed; another seed gives another pair.",
)
@click.option("--force", is_flag=True, help="Replace files that exist.")
@traceback_option
def command(folder: str, seed: int, force: bool) -> None:
    """Write a pair of example scans.

    Two views of one generated room, as a depth camera sees it, go into FOLDER (default: sample) as
    source.ply and target.ply, with the true transform in T_target_source.txt. Metres.
    """
    from geomoe3d.cli.progress import stage_display, stdout_to_stderr
    from geomoe3d.data.sample import write_sample_pair

    with stdout_to_stderr(), stage_display(quiet=False) as stage:
        stage("sample pair")
        paths = write_sample_pair(folder, seed=seed, force=force)
    for path in (paths.source, paths.target, paths.truth):
        click.echo(path)
