"""``geomoe3d register`` and ``register``: two files in, the transform and how sure it is out."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from geomoe3d.cli.errors import HELP, ExitCode, Verb, traceback_option
from geomoe3d.cli.files import check_outputs, part_option
from geomoe3d.cli.parts import configuration_options, scale_option, sensor_place, unit_option

if TYPE_CHECKING:
    from geomoe3d.config import RegistrationConfig
    from geomoe3d.decision.explanation import Explanation
    from geomoe3d.result import RegistrationResult


@dataclass(frozen=True)
class _Outputs:
    """What is to be written, each None where it was not asked for."""

    transforms: tuple[str, ...]
    aligned: str | None
    precision: str
    distances: bool
    picture: str | None
    page: str | None
    report: str | None
    unit: str


@click.command(cls=Verb, context_settings=HELP, short_help="Register one scan to another, and say how sure.")
@click.argument("source", metavar="SOURCE")
@click.argument("target", metavar="TARGET")
@configuration_options
@scale_option
@click.option(
    "--weights",
    metavar="FILE",
    help="Trained network (.safetensors) that scores transforms or rejects outliers.",
)
@click.option(
    "--correspondences",
    metavar="FILE",
    help="Matching points of your own: x y z in SOURCE and in TARGET, six columns (.txt, .csv or .npy).",
)
@click.option("--initial", metavar="FILE", help="A first guess, in any format of --output.")
@click.option(
    "--sensor-source",
    metavar="X,Y,Z",
    help="Where the scanner of SOURCE stood, in the file's coordinates; 'none': at no single place. [found]",
)
@click.option("--sensor-target", metavar="X,Y,Z", help="The same for TARGET. [found]")
@click.option("--inverse", is_flag=True, help="Give the transform that maps TARGET into SOURCE instead.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON and nothing else.")
@click.option(
    "--output",
    "transforms",
    metavar="[FORMAT:]FILE",
    multiple=True,
    help="Write the transform; repeatable. By suffix: .txt (rows, as CloudCompare takes them), .npy, .json "
    "(whole result), .yaml (tf), .tum, .kitti; by name: pdal:FILE, ros:FILE, quaternion:FILE, ...",
)
@click.option("--aligned", metavar="FILE", help="Write all points of SOURCE, moved to their place in TARGET.")
@click.option(
    "--aligned-precision",
    "precision",
    metavar="WHICH",
    default="auto",
    help="Digits of coordinates in PLY and PCD: double, single (fewer, about an origin) or auto. [auto]",
)
@click.option(
    "--distances",
    is_flag=True,
    help="With --aligned: write each point's distance to the nearest point of TARGET as a field 'distance'.",
)
@part_option("reader")
@part_option("writer")
@click.option("--picture", metavar="FILE", help="Write a picture: .png, .pdf, .svg, ...")
@click.option("--page", metavar="FILE", help="Write a web page in which the clouds can be turned: .html.")
@click.option("--report", metavar="FILE", help="Write a report of one page for a customer: .pdf.")
@unit_option
@click.option("--show", is_flag=True, help="Open a window with the aligned clouds; needs a screen.")
@click.option("--force", is_flag=True, help="Replace output files that exist.")
@click.option(
    "--quiet",
    is_flag=True,
    help="Print the four rows of the matrix alone, and one line of warning where the status is not ok.",
)
@traceback_option
@click.pass_context
def command(
    context: click.Context,
    /,
    source: str,
    target: str,
    config: RegistrationConfig,
    weights: str | None,
    correspondences: str | None,
    initial: str | None,
    sensor_source: str | None,
    sensor_target: str | None,
    inverse: bool,
    as_json: bool,
    show: bool,
    force: bool,
    quiet: bool,
    **wanted: Any,
) -> None:
    """Find the rigid transform that registers SOURCE to TARGET: p_target = R p_source + t.

    With --estimate-scale a similarity: p_target = scale R p_source + t.

    SOURCE and TARGET are point clouds or meshes (PLY, PCD, XYZ, NPY, OBJ, STL, LAS, E57, ...). No first
    guess is needed. The transform is given in the files' own coordinates, with a status: ok,
    low_confidence, ambiguous or failed. Exit code 0 for ok, 3 for the others, 2 for unusable input.
    """
    outputs = _Outputs(**wanted)
    read = [source, target, *filter(None, (correspondences, initial, weights))]
    _check_outputs(outputs, read, None if config.scale == "estimate" else 1.0, force)
    if show:
        from geomoe3d.visual.window import check_display

        check_display()

    from geomoe3d.cli.progress import stage_display, stdout_to_stderr

    with stdout_to_stderr(), stage_display(quiet) as stage:
        stage("start")  # importing the libraries below takes a second
        from geomoe3d.clouds.correspondence_files import load_correspondences
        from geomoe3d.clouds.transform_files import load_transform
        from geomoe3d.pipeline import with_weights
        from geomoe3d.registration import Registrar

        registrar = Registrar(config if weights is None else with_weights(config, weights))
        told: dict[str, Any] = {
            "initial": None if initial is None else load_transform(initial),
            "correspondences": None if correspondences is None else load_correspondences(correspondences),
            "sensors": (
                sensor_place(sensor_source, "--sensor-source"),
                sensor_place(sensor_target, "--sensor-target"),
            ),
            "progress": stage,
        }
        explanation: Explanation | None = None
        if show or outputs.picture or outputs.page or outputs.report:
            explanation = registrar.explain(source, target, **told)
            result = explanation.result
        else:
            result = registrar.register(source, target, **told)
    try:
        with stdout_to_stderr(), stage_display(quiet) as stage:
            _write(outputs, result, explanation, (source, target), inverse, force, stage)
    finally:  # a full disk must not cost the answer
        _print(result.inverse() if inverse else result, as_json, quiet, inverse, outputs.unit)
    if show and explanation is not None:
        from geomoe3d.visual.window import show_window

        show_window(explanation.view(outputs.unit))
    context.exit(0 if result.ok else ExitCode.NOT_SURE)


_NEXT = {
    "low_confidence": "look at it with --page FILE.html before you use it; scans that share more, or a first guess "
    "(--initial FILE), can make it sure",
    "ambiguous": "look at it and at the other transform with --page FILE.html; a first guess (--initial FILE), or "
    "scans that see more, can tell the two apart",
}
"""What to do, by status, where the reasons do not say it."""

_NEXT_SCALE = (
    "have the ratio of the lengths estimated too (--estimate-scale), or bring both to one scale first"
)


def _print(answer: RegistrationResult, as_json: bool, quiet: bool, inverted: bool, unit: str) -> None:
    if as_json:
        click.echo(answer.to_json())
    elif quiet:
        from geomoe3d.cli.summary import print_quietly

        print_quietly(answer)
    else:
        from geomoe3d.cli.summary import summary

        color = False if os.environ.get("NO_COLOR") else None
        click.echo(summary(answer, inverted, unit), color=color)
        if answer.has_transform and answer.status in _NEXT:
            from geomoe3d.decision.scale import DIFFERS

            scaled = answer.scale == 1.0 and any(reason.startswith(DIFFERS) for reason in answer.reasons)
            click.echo(f"\nnext: {_NEXT_SCALE if scaled else _NEXT[answer.status]}")


def _check_outputs(outputs: _Outputs, inputs: Sequence[str], scale: float | None, force: bool) -> None:
    """Every output path is refused before the work begins, if it has to be refused at all.

    ``scale``: of the transform, None where it will be estimated.
    """
    from geomoe3d.clouds.io import check_aligned
    from geomoe3d.clouds.transform_files import check_scale_format, transform_format
    from geomoe3d.visual.paper import FORMATS

    wanted = (
        *(("--output", str(transform_format(path)[1]), ()) for path in outputs.transforms),
        ("--aligned", outputs.aligned, ()),
        ("--picture", outputs.picture, FORMATS),
        ("--page", outputs.page, (".html", ".htm")),
        ("--report", outputs.report, (".pdf",)),
    )
    for name in outputs.transforms:
        check_scale_format(*transform_format(name), scale)
    check_outputs(wanted, inputs, force)
    if outputs.aligned is not None:
        settings: dict[str, Any] = {"precision": outputs.precision, "distances": outputs.distances}
        check_aligned(outputs.aligned, inputs[0], **settings, force=force)
    elif outputs.distances or outputs.precision != "auto":
        option = "--distances" if outputs.distances else "--aligned-precision"
        raise click.UsageError(f"{option} is of the file of --aligned; give --aligned FILE too")


def _write(
    outputs: _Outputs,
    result: RegistrationResult,
    explanation: Explanation | None,
    inputs: tuple[str, str],
    inverse: bool,
    force: bool,
    stage: Callable[[str], None],
) -> None:
    """Write what was asked for; what needs a transform where there is none is named on stderr."""
    from geomoe3d import __version__
    from geomoe3d.cli.summary import direction
    from geomoe3d.clouds.transform_files import has_transform, save_result

    skipped: list[str] = []
    lost: tuple[str, ...] = ()
    answer = result.inverse() if inverse else result
    comments = [
        direction(answer, inverse),
        f"status {result.status}, confidence {result.confidence:.4f}, geomoe3d {__version__}",
    ]
    frames = ("source", "target") if inverse else ("target", "source")
    for path in outputs.transforms:
        if not save_result(path, answer, comments, frames=frames, force=force):
            skipped.append(path)
    if outputs.aligned is not None:
        stage("write the aligned cloud")
        if has_transform(result):
            from geomoe3d.clouds.io import save_aligned

            lost = save_aligned(
                outputs.aligned,
                inputs[0],
                result.T_target_source,
                precision=outputs.precision,
                target=inputs[1] if outputs.distances else None,
                scale=result.scale,
                force=force,
                remark=lambda sentence: click.echo(f"note: {sentence}", err=True),
            )
        else:
            skipped.append(outputs.aligned)
    if explanation is not None and (outputs.picture or outputs.page or outputs.report):
        view = explanation.view(outputs.unit)
        if outputs.picture is not None:
            stage("draw the picture")
            from geomoe3d.visual.picture import save_picture

            save_picture(view, outputs.picture, force=force)
        if outputs.page is not None:
            stage("write the page")
            from geomoe3d.visual.page import save_page

            save_page(view, outputs.page, force=force)
        if outputs.report is not None:
            stage("draw the report")
            from geomoe3d.visual.sheet import save_sheet

            save_sheet(view, outputs.report, force=force)
    if lost:
        click.echo(f"not carried over to {outputs.aligned}: {', '.join(lost)}", err=True)
    for path in skipped:
        click.echo(f"not written, for want of a transform: {path}", err=True)
