"""``geomoe3d index``: a large cloud described once, so that scans are found in it quickly."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from geomoe3d.cli.errors import HELP, Verb, traceback_option, use_instead
from geomoe3d.cli.files import is_map, part_option
from geomoe3d.cli.parts import configuration_options
from geomoe3d.runtime.words import counted

if TYPE_CHECKING:
    from geomoe3d.config import RegistrationConfig


@click.command(
    cls=Verb, context_settings=HELP, short_help="Prepare a large cloud as a map, to find scans in it."
)
@click.argument("inputs", metavar="CLOUDS... OUT.map", nargs=-1, required=True)
@click.option(
    "--poses",
    metavar="FILE",
    help="Where each cloud lies in the map, in their order (TUM, KITTI or JSON). [all are in one coordinate system]",
)
@configuration_options
@click.option("--fresh", is_flag=True, help="Begin anew where OUT.map exists; else clouds are added to it.")
@click.option("--quiet", is_flag=True, help="No progress and no summary.")
@part_option("reader")
@traceback_option
def command(
    inputs: tuple[str, ...], poses: str | None, config: RegistrationConfig, fresh: bool, quiet: bool
) -> None:
    """Prepare CLOUDS (files, or folders of them) as one map, the file OUT.map.

    `geomoe3d locate` finds scans in it. Called again with more clouds, or after an interruption, it reads only those
    that are not in it yet. Where one has changed, or has another pose, all are read anew if all are given, else it
    is an error. LAS, LAZ, binary PLY and E57 are read in pieces. With --poses each cloud is one scan in
    coordinates of its own.
    """
    if len(inputs) < 2:
        raise click.UsageError("give at least one cloud, and OUT.map last")
    maps = [name for name in inputs[:-1] if is_map(name)]
    if maps:
        others = [name for name in inputs if name not in maps]
        raise use_instead("the map is written and comes last, behind its clouds", *others, maps[-1])
    if not is_map(inputs[-1]):
        rule = "the last name is that of the map to write and ends in .map"
        if Path(inputs[-1]).exists():
            raise use_instead(f"{rule}, but '{inputs[-1]}' is there", *inputs, "NAME.map")
        raise use_instead(f"{rule}, found '{inputs[-1]}'", *inputs[:-1], f"{inputs[-1]}.map")
    from geomoe3d.cli.progress import stage_display, stdout_to_stderr

    with stdout_to_stderr(), stage_display(quiet) as stage:
        stage("start")
        from geomoe3d.clouds.io import load_points
        from geomoe3d.clouds.viewpoint import find_viewpoints
        from geomoe3d.errors import OutputError
        from geomoe3d.maps.map import Map
        from geomoe3d.maps.store import StaleMapError, looks_like_map
        from geomoe3d.multiway.initial import read_poses
        from geomoe3d.multiway.scans import find_clouds
        from geomoe3d.runtime.files import check_output

        out = check_output(inputs[-1], force=True)
        if out.exists() and fresh and not looks_like_map(out):
            raise OutputError(f"'{out}' exists and is no map of geomoe3d; remove it, or give another name")
        scans = find_clouds(inputs[:-1])
        where = None if poses is None else read_poses(poses, [scan.name for scan in scans])
        old = out.exists()
        made = Map.open(out, config=config) if old and not fresh else Map.empty(config=config)

        def with_all(made: Map, *, keep: bool) -> Map:
            kept = time.monotonic()
            for number, scan in enumerate(scans):
                stage(f"read {Path(scan.path).name}")
                if where is None:
                    made = made.with_cloud(scan.path)
                else:
                    cloud = load_points(scan.path)
                    view = find_viewpoints(cloud, cloud, config.preparation.viewpoint)[0]
                    sensor = None if view is None else view + cloud.origin
                    made = made.with_cloud(scan.path, T_map_cloud=where[number], sensor=sensor)
                # A minute after the last time, what was read so far is written, where the file loses nothing by it.
                if keep and time.monotonic() - kept > 60.0:
                    made.save(out, force=True)
                    kept = time.monotonic()
            return made

        before, anew = made.sources, ""
        try:
            made = with_all(made, keep=not (old and fresh))
        except StaleMapError as error:
            # What was given makes all of the map: nothing is lost where it begins anew, but for poses. The old map
            # stays until the new one is complete: a later cloud may be one that cannot be read.
            posed = where is None and any(source.T_map_cloud for source in before)
            if posed or not {source.path for source in before} <= {
                str(Path(scan.path).resolve()) for scan in scans
            }:
                raise
            before, anew = (), f"{str(error).split(';')[0]}: all clouds were read anew"
            made = with_all(Map.empty(config=config), keep=False)
        doubles = sorted({s.name for s in before} & {s.name for s in made.sources[len(before) :]})
        made.describe(progress=stage)
        stage("write")
        made.save(out, force=True)
    if anew:
        click.echo(anew, err=True)
    for name in doubles:
        click.echo(
            f"warning: the map held another '{name}' already, of another folder or other content; both are in it now, "
            "begin anew with --fresh if that was the same scan",
            err=True,
        )
    if where is None and len(made.sources) > max(len(before), 1) and not quiet:
        click.echo(
            "note: all clouds are taken as they are, in one coordinate system and one unit; scans in coordinates of "
            "their own need --poses",
            err=True,
        )
    if config.voxel_size is not None and config.voxel_size < made.voxel_sizes[0]:
        click.echo(
            f"note: the map keeps no points closer than {made.voxel_sizes[0]:.4g}, so it is described on that grid, "
            f"not on one of {config.voxel_size:g}",
            err=True,
        )
    if not quiet:
        added = len(made.sources) - len(before)
        sizes = ", ".join(f"{size:.4g}" for size in made.voxel_sizes)
        clouds, grids = (
            counted(len(made.sources), "cloud"),
            "a grid" if len(made.voxel_sizes) == 1 else "grids",
        )
        click.echo(
            f"{out}: {counted(made.num_points, 'point')} of {clouds} ({added} new), indexed on {grids} of {sizes}"
        )
