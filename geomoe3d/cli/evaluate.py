"""``geomoe3d evaluate``: predict into a cache, score it, compare two runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geomoe3d.cli.errors import HELP, ExitCode, Verb, command_line, traceback_option
from geomoe3d.cli.parts import Number, method_part_options, together
from geomoe3d.runtime.words import counted

if TYPE_CHECKING:
    from geomoe3d.evaluation.score import ScoredRun


@click.group(context_settings=HELP, short_help="Measure registration methods on benchmarks.")
def command() -> None:
    """Measure registration methods on benchmarks: recall, errors, confidence, time."""


_prediction_options = together(
    click.argument("study", metavar="OUT", type=click.Path(file_okay=False)),
    click.option(
        "--method",
        "methods",
        metavar="NAME",
        multiple=True,
        required=True,
        help="A name from `evaluate methods`, or FILE.py:FUNCTION. Repeatable.",
    ),
    click.option(
        "--benchmark",
        "benchmarks",
        metavar="NAME",
        multiple=True,
        default=("3DMatch",),
        show_default=True,
        help="3DMatch, 3DLoMatch, unrelated, or a folder. Repeatable.",
    ),
    click.option(
        "--track",
        metavar="NAME",
        default="clouds",
        show_default=True,
        help="Input: 1k or all (fixed correspondences), or clouds (end to end).",
    ),
    click.option(
        "--every", metavar="N", type=Number(1), default=1, show_default=True, help="Use every n-th pair only."
    ),
    click.option(
        "--unrelated",
        "num_unrelated",
        metavar="N",
        type=Number(0),
        default=200,
        show_default=True,
        help="Number of pairs of the benchmark unrelated.",
    ),
    click.option(
        "--set",
        "assignments",
        metavar="KEY=VALUE",
        multiple=True,
        help="Configuration of geomoe3d and of networks with weights of yours; repeatable.",
    ),
    method_part_options,
    click.option("--label", metavar="NAME", help="Name of the run, if there is one method. [the method's]"),
    click.option("--data", "root", metavar="FOLDER", help="Folder of the benchmarks. [GEOMOE3D_DATA]"),
    click.option(
        "--workers",
        metavar="N",
        type=Number(1),
        default=1,
        show_default=True,
        help="Processes; with two or more, a method that crashes loses one pair only.",
    ),
    click.option(
        "--seed",
        metavar="N",
        type=Number(0),
        default=0,
        show_default=True,
        help="Random seed of the methods.",
    ),
    click.option("--fresh", is_flag=True, help="Remove the stored answers of these runs first."),
)


@command.command(
    cls=Verb, context_settings=HELP, short_help="Run methods on benchmarks and store their answers."
)
@_prediction_options
@traceback_option
def predict(**given: Any) -> None:
    """Run methods on the pairs of benchmarks and store their answers in the folder OUT.

    All methods register each pair in turn, from the same input. An interrupted run is continued; answers of
    other settings, code or input are refused, never mixed.
    """
    _predict(**given)


@command.command(cls=Verb, context_settings=HELP, short_help="Predict, score, and write reports.")
@_prediction_options
@traceback_option
def run(**given: Any) -> None:
    """Predict, score, and write OUT/report.html, report.md and report.json (replaced each time)."""
    from geomoe3d.evaluation.score import write_report

    _predict(**given)
    study = Path(given["study"])
    runs = _score(study, raw=False)
    _print_table(runs)
    for suffix in (".html", ".md", ".json"):
        write_report(study / f"report{suffix}", runs, force=True)
    click.echo(f"report: {study / 'report.html'}")


@command.command(cls=Verb, context_settings=HELP, short_help="Score the answers that are stored.")
@click.argument("study", metavar="OUT", type=click.Path(file_okay=False))
@click.option("--raw", is_flag=True, help="Use the true rotations as published, not projected onto SO(3).")
@click.option(
    "--report",
    "reports",
    metavar="FILE",
    multiple=True,
    help="Write a report: .html, .md or .json; repeatable.",
)
@click.option("--force", is_flag=True, help="Replace reports that exist.")
@click.option("--quiet", is_flag=True, help="Print no table.")
@traceback_option
def score(study: str, raw: bool, reports: tuple[str, ...], force: bool, quiet: bool) -> None:
    """Score the predictions in OUT: recall, errors, precision and recall of inliers, time, calibration."""
    from geomoe3d.errors import InputError
    from geomoe3d.evaluation.score import REPORT_SUFFIXES, write_report
    from geomoe3d.runtime.files import check_output

    for report in reports:
        if Path(report).suffix not in REPORT_SUFFIXES:
            raise InputError(f"cannot write '{report}': a report is {', '.join(REPORT_SUFFIXES)}")
        check_output(report, force=force)
    runs = _score(Path(study), raw=raw)
    if not quiet:
        _print_table(runs)
    for report in reports:
        write_report(report, runs, force=force)


@command.command(cls=Verb, context_settings=HELP, short_help="Compare two runs pair by pair.")
@click.argument("first", metavar="RUN", type=click.Path(file_okay=False))
@click.argument("second", metavar="RUN", type=click.Path(file_okay=False))
@traceback_option
def compare(first: str, second: str) -> None:
    """Compare two runs pair by pair: pairs that only one gets right, McNemar's test, ratio of the times."""
    from geomoe3d.errors import InputError
    from geomoe3d.evaluation.compare import compare as compare_scores
    from geomoe3d.evaluation.report_text import terminal_comparison

    runs = [_score(Path(folder), raw=False) for folder in (first, second)]
    for folder, found in zip((first, second), runs, strict=True):
        if len(found) != 1:
            raise InputError(f"'{folder}' holds {counted(len(found), 'run')}; give the folder of one of them")
    a, b = (found[0].score for found in runs)
    click.echo(terminal_comparison(a, b, compare_scores(a, b)))


@command.command(cls=Verb, context_settings=HELP, short_help="List the methods and what is not installed.")
@traceback_option
def methods() -> None:
    """List the methods, the inputs each accepts, and what is not installed."""
    from geomoe3d.evaluation.methods import TRAINED, make_method, method_names

    for name in method_names():
        method = make_method(name)
        reason = method.absent()
        click.echo(
            f"{name:24} {', '.join(sorted(method.inputs)):26} {'' if reason is None else reason}".rstrip()
        )
    for name in TRAINED:
        click.echo(f"{name:24} {'correspondences':26} with weights of yours: --set filter.weights=FILE")


@command.command(cls=Verb, context_settings=HELP, short_help="Measure poses or homographies of photographs.")
@click.argument("folders", metavar="FOLDER...", nargs=-1, required=True, type=click.Path(exists=True))
@click.option("--weights", metavar="FILE", help="Network that weighs matches (.safetensors).")
@click.option(
    "--pairs",
    metavar="N",
    default=200,
    show_default=True,
    type=Number(2),
    help="Per scene, at most: half turned by 3 to 20 degrees, half by 20 to 60; or warps, two an image.",
)
@click.option("--homographies", is_flag=True, help="Homographies in place of poses.")
@click.option("--images", metavar="FOLDER", help="Where the images of a list of pairs lie.")
@click.option(
    "--keep",
    metavar="FOLDER",
    type=click.Path(file_okay=False),
    help="Folder that keeps each finished pair: the same call goes on where it was stopped.",
)
@click.option("--output", metavar="FILE", help="Write all errors as JSON.")
@click.option("--force", is_flag=True, help="Replace a file that exists.")
@traceback_option
def images(
    folders: tuple[str, ...], weights: str | None, pairs: int, homographies: bool, images: str | None,
    keep: str | None, output: str | None, force: bool,
) -> None:  # fmt: skip
    """Measure poses or homographies of photographs: areas under the recall curve, with intervals.

    For poses each FOLDER holds photographs with cameras, also as published for YFCC100M and SUN3D, whose pairs
    come with it, or is a list of pairs (38 words a line). For homographies it is a sequence of HPatches, a folder
    with NAME_pts.txt and NAME_model.txt, or any images or scene, of which exact warps are made.
    """
    import json

    from geomoe3d.cli.progress import progress_bar
    from geomoe3d.images.cases import cases_of
    from geomoe3d.images.config import MEASURE
    from geomoe3d.images.evaluate import Outcome, evaluate, evaluate_kept, summarise, to_markdown
    from geomoe3d.images.network import ImageNetwork
    from geomoe3d.runtime.files import check_output, file_hash, write_text
    from geomoe3d.runtime.plain import plain

    if output is not None:
        check_output(output, force=force)
    network = None if weights is None else ImageNetwork(weights)
    root = None if images is None else Path(images)
    places = [Path(folder).resolve() for folder in folders]
    if twice := [folder for folder, place in zip(folders, places, strict=True) if places.count(place) > 1]:
        raise click.UsageError(f"'{twice[0]}' is given more than once; its pairs would count twice")
    stems = [place.stem for place in places]
    names = stems if len(set(stems)) == len(stems) else folders  # a name stands for one scene
    outcomes: list[Outcome] = []
    with progress_bar("scenes") as advance:
        advance(0, len(folders))
        for number, (name, folder) in enumerate(zip(names, folders, strict=True), 1):
            cases = cases_of(Path(folder), pairs, homographies, root)
            if keep is None:
                outcomes += evaluate(name, cases, network)
            else:
                used = None if weights is None else file_hash(Path(weights))
                given = {"folder": folder, "images": images, "pairs": pairs, "homographies": homographies}
                place = Path(keep) / f"{number}-{Path(folder).resolve().stem}"
                outcomes += evaluate_kept(place, name, {**given, "weights": used}, cases, network)
            advance(number, len(folders))
    table = summarise(outcomes, MEASURE.corner if homographies else MEASURE.pose)
    click.echo(to_markdown(table, len({(one.scene, one.pair) for one in outcomes})), nl=False)
    if output is not None:
        write_text(Path(output), json.dumps(plain({"summary": table, "pairs": outcomes})) + "\n", force=force)


def _predict(
    study: str,
    methods: tuple[str, ...],
    benchmarks: tuple[str, ...],
    track: str,
    every: int,
    num_unrelated: int,
    assignments: tuple[str, ...],
    label: str | None,
    root: str | None,
    workers: int,
    seed: int,
    fresh: bool,
) -> None:
    from geomoe3d.cli.progress import progress_bar, stdout_to_stderr
    from geomoe3d.errors import InputError
    from geomoe3d.evaluation.evaluation_set import EvaluationSet
    from geomoe3d.evaluation.methods import CONFIGURABLE
    from geomoe3d.evaluation.predict import MethodSpec, predict

    if label is not None and len(methods) != 1:
        raise InputError(f"--label names one run, but {len(methods)} methods are given; give one method")
    if assignments and not CONFIGURABLE & set(methods):
        takers = ", ".join(sorted(CONFIGURABLE))
        raise InputError(f"--set, --filter and the like are for {takers}, which are not among those given")
    specs = [MethodSpec(name, assignments if name in CONFIGURABLE else (), label) for name in methods]
    sets = [EvaluationSet(benchmark, track, root, every, num_unrelated, seed) for benchmark in benchmarks]
    for one in sets[1:]:
        one.pairs()  # a wrong name is told at once, not when the first benchmark is done
    made = absent = 0
    for one in sets:
        with stdout_to_stderr(), progress_bar("predictions") as advance:
            report = predict(
                study, specs, one, workers=workers, fresh=fresh, command=command_line(), progress=advance
            )
        for name, reason in report.absent.items():
            click.echo(f"absent: {name}: {reason}", err=True)
        made, absent = made + report.made + report.kept, len(report.absent)
    if not made:
        click.echo("nothing was predicted", err=True)
        click.get_current_context().exit(ExitCode.BAD_INPUT if absent else 0)


def _score(study: Path, *, raw: bool) -> list[ScoredRun]:
    from geomoe3d.cli.progress import progress_bar
    from geomoe3d.evaluation.score import score_runs

    with progress_bar("runs", quiet=not sys.stderr.isatty()) as advance:
        return score_runs(study, raw_truth=raw, progress=advance)


def _print_table(runs: list[ScoredRun]) -> None:
    import shutil

    from geomoe3d.evaluation.report_text import terminal_table

    width = shutil.get_terminal_size((0, 0)).columns or None
    color = sys.stdout.isatty() and not os.environ.get("NO_COLOR")
    click.echo(terminal_table([run.score for run in runs], width=width, color=color))
