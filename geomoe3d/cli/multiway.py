"""``geomoe3d multiway``: many scans in, one model out, and why a scan could not be placed."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import click

from geomoe3d.cli.errors import HELP, ExitCode, Verb, traceback_option
from geomoe3d.cli.files import part_option
from geomoe3d.cli.parts import Number, cache_options, configuration_options, worker_options
from geomoe3d.multiway.defaults import ALL_PAIRS_UP_TO, MOST_ROUNDS, NEIGHBORS
from geomoe3d.runtime.words import counted

if TYPE_CHECKING:
    from geomoe3d.multiway.model import SceneModel


@click.command(cls=Verb, context_settings=HELP, short_help="Register many scans into one model.")
@click.argument("inputs", metavar="SCANS... OUT", nargs=-1, required=True)
@click.option(
    "--pairs",
    metavar="WHICH",
    default="auto",
    help=f"Pairs to register: all, similar, or auto (all for up to {ALL_PAIRS_UP_TO} scans). [auto]",
)
@click.option(
    "--neighbors",
    type=Number(1),
    default=NEIGHBORS,
    metavar="N",
    help=f"Pairs tried per scan, twice as many in each further round. [{NEIGHBORS}]",
)
@click.option(
    "--model-voxel-size",
    "merged_voxel_size",
    type=Number(above=0, whole=False),
    metavar="LENGTH",
    help="Edge of a voxel of the merged cloud. [that of the scans]",
)
@click.option(
    "--rounds",
    type=Number(0),
    default=MOST_ROUNDS,
    metavar="N",
    help=f"Rounds of further pairs for scans that are not connected yet. [{MOST_ROUNDS}]",
)
@worker_options
@configuration_options
@click.option("--sequence", is_flag=True, help="The scans are in the order in which they were taken.")
@click.option(
    "--initial",
    metavar="FILE",
    help="A pose per scan (TUM, KITTI or JSON), such as of odometry; implies --sequence.",
)
@click.option(
    "--initial-error",
    nargs=2,
    type=Number(above=0, whole=False),
    metavar="LENGTH DEGREES",
    help="Standard deviation of the transform between two scans by these poses. [2 voxels, 2 degrees]",
)
@click.option(
    "--second-look",
    type=click.Choice(["all", "none"]),
    default="none",
    metavar="WHICH",
    help="Doubtful pairs to look at twice, at several times the time: all, or none. [none]",
)
@click.option(
    "--optimizer",
    type=click.Choice(["open3d", "gtsam"]),
    default="open3d",
    metavar="NAME",
    help="Library that fits the poses to the pairs: open3d, or gtsam where it is installed. [open3d]",
)
@click.option("--e57", is_flag=True, help="Write OUT/groupN.e57 too: every point, each scan with its pose.")
@click.option("--page/--no-page", default=True, help="Write OUT/page.html, or do not. [--page]")
@click.option("--fresh", is_flag=True, help="Delete the earlier model in OUT first.")
@cache_options
@click.option("--quiet", is_flag=True, help="No progress and no summary.")
@part_option("reader")
@traceback_option
@click.pass_context
def command(
    context: click.Context,
    /,
    inputs: tuple[str, ...],
    merged_voxel_size: float | None,
    quiet: bool,
    **given: Any,
) -> None:
    """Register all SCANS (files, or folders of them) into one model, written to the folder OUT.

    Scans without a reliable connection form separate groups; a scan that cannot be placed is listed with
    the reason. Called again with more scans, it reuses all pairs that were registered before. Exit code 0 if
    all scans are in one group and nothing is doubted (scale, units, mirrored axes, repeated structure), 3 if not, 2 for
    unusable input.
    """
    from geomoe3d.cli.progress import progress_bar, stdout_to_stderr

    if len(inputs) < 2:
        raise click.UsageError("give at least one folder of scans, or two scans, and OUT last")
    from geomoe3d.multiway.run import register_scans

    with stdout_to_stderr(), progress_bar("pairs", quiet=quiet) as progress:
        model = register_scans(
            inputs[:-1],
            inputs[-1],
            merged_voxel_size=merged_voxel_size,
            progress=progress,
            say=lambda text: None if quiet else click.echo(text, err=True),
            **given,
        )
    if not quiet:
        click.echo(summary(model), color=False if os.environ.get("NO_COLOR") else None)
    context.exit(0 if model.ok else ExitCode.NOT_SURE)


def summary(model: SceneModel) -> str:
    """Who stands where, and who does not."""
    from geomoe3d.multiway.scans import copies_in_words

    placed = sum(len(group.poses) for group in model.groups)
    color = "green" if model.ok else "yellow"
    kept = sum(edge.kept for edge in model.edges)
    lines = [
        click.style(f"{placed} of {counted(len(model.scans), 'scan')} placed", fg=color, bold=True)
        + f"; {counted(model.num_pairs, 'pair')} registered, {counted(kept, 'edge')} kept; model in {model.folder}",
    ]
    for number, group in enumerate(model.groups, start=1):
        closed = sum(loop.closes for loop in group.loops)
        lines.append(
            f"  group {number}: {counted(len(group.poses), 'scan')} in the frame of '{group.reference}'; "
            f"loops that close: {closed} of {len(group.loops)}"
        )
        said = [text for text in (group.repeated, group.bent) if text]
        lines += [click.style(f"    {text}", fg="yellow") for text in said]
    lines += [f"  {name} may be wrong: {reason}" for name, reason in model.doubted.items()]
    lines += [f"  {told}" for told in copies_in_words(model.copies)]
    if model.unplaced:
        lines.append("not placed:")
    shown = list(model.unplaced.items())[:20]
    lines += [f"  {name}: {reason}" for name, reason in shown]
    if len(model.unplaced) > len(shown):
        lines.append(f"  and {len(model.unplaced) - len(shown):,} more, see poses.json")
    return "\n".join(lines)
