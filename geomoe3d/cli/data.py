"""``geomoe3d data``: look through, make and prepare training data."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from geomoe3d.cli.errors import (
    HELP,
    ExitCode,
    Verb,
    refuse_bare_settings,
    renamed,
    renamed_verb,
    traceback_option,
)
from geomoe3d.cli.parts import Number, Option
from geomoe3d.runtime.words import counted

if TYPE_CHECKING:
    from geomoe3d.data.check import CheckReport
    from geomoe3d.types import FloatArray


def _number(name: str, metavar: str, default: float, kind: Number, text: str) -> Option:
    return click.option(name, metavar=metavar, default=default, show_default=True, type=kind, help=text)


_workers = _number("--workers", "N", 1, Number(1), "Processes.")
_min_overlap = _number(
    "--min-overlap", "SHARE", 0.1, Number(0, 1, whole=False), "Least overlap of a pair that is listed."
)


@click.group(context_settings=HELP)
def command() -> None:
    """Check, generate and prepare training and test data."""


@command.command(cls=Verb, context_settings=HELP, short_help="Check a folder of data and name broken files.")
@click.argument("root", type=click.Path())
@click.option("--quick", is_flag=True, help="List only; do not open the fragments.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@traceback_option
@click.pass_context
def check(context: click.Context, root: str, quick: bool, as_json: bool) -> None:
    """Say which layout ROOT has, compare it with what was published, and name every broken file.

    Of photographs with cameras it says how far matches lie from the epipolar lines that the cameras give.

    Exit code 0 when every listed pair can be used, else 2.
    """
    from pathlib import Path

    from geomoe3d.cli.progress import progress_bar
    from geomoe3d.data.check import check_folder
    from geomoe3d.images.scenes import layout_of, read_scene

    if layout_of(Path(root)) is not None:
        from geomoe3d.images.pairs import check_truth

        truth = check_truth(read_scene(root))
        click.echo(json.dumps(asdict(truth)) if as_json else (
            f"{root}: photographs with cameras, layout {truth.layout}, {truth.num_views} views"
            + "".join(f"\nnote: {note}" for note in truth.notes)
            + f"\n{counted(truth.num_matches, 'match', 'matches')} of {counted(truth.num_pairs, 'pair')}: "
            f"{truth.share:.0%} within 2 pixels of their epipolar lines (at least 60 %), median {truth.median:.2f} "
            "(at most 1)\n"
            + ("usable" if truth.usable else "not usable: the cameras are not those of the photographs")
        ))  # fmt: skip
        context.exit(0 if truth.usable else ExitCode.BAD_INPUT)
    with progress_bar("fragments", quiet=as_json) as advance:
        report = check_folder(root, open_files=not quick, progress=advance)
    if as_json:
        click.echo(json.dumps({**asdict(report), "usable": report.usable}, default=str))
    else:
        _print(report)
    context.exit(0 if report.usable else ExitCode.BAD_INPUT)


def _print(report: CheckReport) -> None:
    click.echo(f"{report.root}: layout {report.layout}")
    pairs = ", ".join(f"{count} {group}" for group, count in report.num_pairs.items()) or "no pairs"
    click.echo(f"{counted(report.num_scenes, 'scene')}, {counted(report.num_fragments, 'fragment')}, {pairs}")
    for row in report.scenes:
        split = f" [{row['split']}]" if row["split"] else ""
        published = f" of {row['published_fragments']}" if row["published_fragments"] else ""
        counts = ", ".join(f"{count} {group}" for group, count in row["pairs"].items())
        click.echo(
            f"  {row['scene']}{split}: {row['fragments']}{published} fragments; {counts or 'no pairs'}"
        )
    for title, lines in (("broken", report.broken), ("missing", report.missing), ("note", report.notes)):
        for line in lines:
            click.echo(f"{title}: {line}")
    click.echo("usable" if report.usable else "not usable as it is")


@command.command(cls=Verb, context_settings=HELP, short_help="Fuse depth frames into fragments.")
@click.argument("frames", type=click.Path())
@click.argument("out", type=click.Path())
@_number("--count", "N", 50, Number(1), "Number of frames fused into one fragment.")
@_number("--voxel-size", "LENGTH", 0.006, Number(above=0, whole=False), "Edge of the fusion grid, metres.")
@_number("--max-depth", "LENGTH", 6.0, Number(above=0, whole=False), "Greater depths are not used, metres.")
@click.option(
    "--whole", is_flag=True, help="Keep points outside the 3 m cube to which 3DMatch cut its fragments."
)
@click.option(
    "--grid",
    metavar="LENGTH",
    type=Number(above=0, whole=False),
    help="Keep one point per cell of this edge, metres (default: all).",
)
@_min_overlap
@click.option(
    "--convention",
    type=click.Choice(("7scenes", "tum", "plain")),
    help="Default: recognised by the files in FRAMES.",
)
@click.option(
    "--intrinsics",
    metavar="FX,FY,CX,CY",
    help="Focal lengths and centre, pixels (default: the folder's file).",
)
@click.option(
    "--depth-unit",
    metavar="NUMBER",
    type=Number(above=0, whole=False),
    help="Depth values per metre (default: 1000, TUM 5000).",
)
@click.option(
    "--invalid",
    metavar="N",
    type=Number(0),
    multiple=True,
    help="Depth value that means none (default: 0 and 65535); repeatable.",
)
@renamed("--voxel", "--voxel-size")
@traceback_option
def fragments(
    frames: str,
    out: str,
    count: int,
    voxel_size: float,
    max_depth: float,
    whole: bool,
    grid: float | None,
    min_overlap: float,
    convention: str | None,
    intrinsics: str | None,
    depth_unit: float | None,
    invalid: tuple[int, ...],
) -> None:
    """Fuse the depth FRAMES of a folder into fragments with ground truth, into the new folder OUT.

    FRAMES holds frame-*.depth.png with *.pose.txt (7-Scenes, 3DMatch), depth.txt with groundtruth.txt (TUM),
    or depth/*.png with poses.txt. Poses are camera to world. Unusable frames are named and skipped.
    """
    from geomoe3d.cli.progress import progress_bar, stdout_to_stderr
    from geomoe3d.data.fragments import make_fragments
    from geomoe3d.data.fusion import THREEDMATCH_VOLUME, FusionSettings
    from geomoe3d.data.rgbd import open_recording

    with stdout_to_stderr(), progress_bar("fragments") as advance:
        recording = open_recording(
            frames,
            convention=convention,
            intrinsics=None if intrinsics is None else _intrinsics(intrinsics),
            per_metre=depth_unit,
            invalid=invalid or (0, 65535),
        )
        report = make_fragments(
            recording,
            out,
            frames_per_fragment=count,
            settings=FusionSettings(
                voxel_size=voxel_size,
                truncation=5 * voxel_size,
                max_depth=max_depth,
                volume=None if whole else THREEDMATCH_VOLUME,
            ),
            min_overlap=min_overlap,
            grid=grid,
            progress=advance,
        )
    for line in report.skipped:
        click.echo(f"skipped: {line}", err=True)
    points = ", ".join(str(number) for number in report.num_points)
    click.echo(
        f"{counted(len(report.num_points), 'fragment')} ({points} points), {counted(report.num_pairs, 'pair')} in "
        f"{out}/gt.log"
    )


def _intrinsics(text: str) -> FloatArray:
    import numpy as np

    try:
        fx, fy, cx, cy = (float(word) for word in text.split(","))
    except ValueError:
        raise click.BadParameter(f"'{text}' is not four numbers fx,fy,cx,cy") from None
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


@command.command(cls=Verb, context_settings=HELP, short_help="Generate rooms and record fragments in them.")
@click.argument("out", type=click.Path())
@click.argument("bare", nargs=-1, metavar="")
@click.option("--set", "assignments", metavar="KEY=VALUE", multiple=True, help="One setting; repeatable.")
@click.option("--scenes", required=True, metavar="N", type=Number(1), help="Scenes of the set.")
@_workers
@_number("--seed", "N", 0, Number(0), "Another seed, another set.")
@click.option(
    "--models",
    "model_folders",
    multiple=True,
    metavar="FOLDER",
    help="Folder of furniture models; repeatable.",
)
@click.option(
    "--mesh", "meshes", multiple=True, metavar="FILE", help="Whole scene to walk through; repeatable."
)
@click.option("--config", metavar="FILE", help="YAML file of settings (see configs/data).")
@click.option("--show", is_flag=True, help="Print the complete settings and stop.")
@traceback_option
def synthesize(
    out: str,
    bare: tuple[str, ...],
    assignments: tuple[str, ...],
    config: str | None,
    show: bool,
    **given: Any,
) -> None:
    """Generate furnished rooms and record fragments in them, into the folder OUT.

    --set recorder=scanner takes laser scans instead, --set recorder=orbit views of single bodies. Rooms are
    made of simple solids alone unless --models or --mesh give more. Same seed, settings and material: same
    bytes, whatever the number of workers. Started again, an interrupted run goes on. OUT gets folders
    scene-NNNNN (cloud_bin_N.ply, gt.log), report.md and contact.png.
    """
    from pathlib import Path

    from geomoe3d.cli.progress import progress_bar, stdout_to_stderr
    from geomoe3d.config import build_config, read_yaml, set_keys, yaml_text
    from geomoe3d.data.contact import draw_contact_sheet
    from geomoe3d.data.report import report_text, write_report
    from geomoe3d.data.settings import SynthesisSettings
    from geomoe3d.data.synthesize import scene_name
    from geomoe3d.data.synthesize import synthesize as make

    refuse_bare_settings(bare)
    tree = set_keys(read_yaml(config) if config else {}, list(assignments))
    settings = build_config(SynthesisSettings, tree, config or "settings")
    if show:
        click.echo(yaml_text(settings), nl=False)
        return
    with stdout_to_stderr(), progress_bar("scenes") as advance:
        report = make(out, given.pop("scenes"), settings=settings, progress=advance, **given)
        write_report(report, Path(out) / "report.md")
        some = [Path(out) / scene_name(scene.number) for scene in report.scenes if scene.num_points][:8]
        if some:
            draw_contact_sheet(some, Path(out) / "contact.png", force=True)
    click.echo(report_text(report), nl=False)


@command.command(cls=Verb, context_settings=HELP, short_help="Compute the features of fragments once.")
@click.argument("root", type=click.Path())
@click.argument("out", type=click.Path())
@click.option(
    "--group",
    "groups",
    metavar="NAME",
    multiple=True,
    help="List of pairs to take, e.g. train_info; repeatable.",
)
@click.option(
    "--scene", "scenes", metavar="NAME", multiple=True, help="Scene to take (default: all); repeatable."
)
@click.option(
    "--split",
    type=click.Choice(("train", "validation", "test")),
    help="Take the scenes of a published split of 3DMatch alone (default: all scenes).",
)
@_min_overlap
@_number(
    "--voxel-size",
    "LENGTH",
    0.05,
    Number(above=0, whole=False),
    "Edge of a voxel, in the unit of the fragments.",
)
@_workers
@traceback_option
@click.pass_context
def features(
    context: click.Context,
    /,
    root: str,
    out: str,
    groups: tuple[str, ...],
    scenes: tuple[str, ...],
    **given: Any,
) -> None:
    """Compute the features of the fragments of ROOT once and store them in OUT, where training reads them.

    ROOT is any folder that 'geomoe3d data check' knows. Started again, it goes on; a shard that no longer
    fits its fragments or settings is refused. Train with --set data.train=OUT. Exit code 2 when OUT got no
    shard.
    """
    from geomoe3d.cli.progress import progress_bar, stdout_to_stderr
    from geomoe3d.data.describe import describe_collection

    with stdout_to_stderr(), progress_bar("scenes") as advance:
        report = describe_collection(
            root, out, groups=groups or None, scenes=scenes or None, progress=advance, **given
        )
    for line in report.skipped:
        click.echo(f"skipped: {line}", err=True)
    click.echo(
        f"{counted(report.made, 'shard')} made ({counted(report.num_fragments, 'fragment')}, "
        f"{counted(report.num_pairs, 'pair')}), "
        f"{report.kept} kept, in {out}"
    )
    context.exit(0 if report.made or report.kept else ExitCode.BAD_INPUT)


@command.command(cls=Verb, context_settings=HELP, short_help="Match photographs with cameras, to train on.")
@click.argument("scenes", nargs=-1, required=True, type=click.Path())
@click.argument("out", type=click.Path())
@_number("--pairs", "N", 1000, Number(2), "Per scene, at most.")
@click.option("--leave-out", metavar="NAME", multiple=True, help="Scene to validate on alone; repeatable.")
@traceback_option
def images(scenes: tuple[str, ...], out: str, pairs: int, leave_out: tuple[str, ...]) -> None:
    """Match the photographs of SCENES and store the matches, with their labels, in the new folder OUT.

    SCENES are folders of photographs with cameras; those whose cameras are not true are refused. Scenes left out go
    into OUT/validation, the others into OUT/train. Train with --set data.train=OUT/train and --set
    data.validation=OUT/validation (configs/train/images).
    """
    from geomoe3d.cli.progress import progress_bar
    from geomoe3d.training.photographs import write_training_set

    with progress_bar("scenes") as advance:
        made = write_training_set(scenes, out, count=pairs, left_out=leave_out, progress=advance)
    for name, number in made.items():
        click.echo(f"{name}: {counted(number, 'pair')}{', left out' if name in leave_out else ''}")


@command.command(
    cls=Verb, context_settings=HELP, short_help="Draw pairs with proposed transforms, to train on."
)
@click.argument("features", type=click.Path())
@click.argument("out", type=click.Path())
@click.option(
    "--pairs", required=True, metavar="N", type=Number(1), help="Pairs to draw, rounded up to whole hundreds."
)
@_number("--seed", "N", 0, Number(0), "Another seed, other pairs.")
@_workers
@traceback_option
@click.pass_context
def transforms(context: click.Context, features: str, out: str, pairs: int, seed: int, workers: int) -> None:
    """Draw pairs from the shards FEATURES and store them with the transforms that consensus proposes in OUT.

    FEATURES is what 'geomoe3d data features' made. A network that scores transforms trains on OUT
    (configs/train/transforms.yaml, --set data.train=OUT). Started again, it goes on. Exit code 2 when a shard
    fails.
    """
    from geomoe3d.cli.progress import progress_bar, stdout_to_stderr
    from geomoe3d.training.motions import propose_motions

    with stdout_to_stderr(), progress_bar("shards") as advance:
        report = propose_motions(features, out, pairs, seed=seed, workers=workers, progress=advance)
    for line in report.failed:
        click.echo(f"failed: {line}", err=True)
    click.echo(f"{counted(report.made, 'shard')} made, {report.kept} kept, in {out}")
    context.exit(ExitCode.BAD_INPUT if report.failed else 0)


renamed_verb(command, "motions", "transforms")
