"""``geomoe3d locate``: where scans lie in a map, and how sure that is."""

from __future__ import annotations

import json
import os
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from geomoe3d.cli.errors import HELP, ExitCode, Verb, traceback_option, use_instead
from geomoe3d.cli.files import check_outputs, is_map, part_option
from geomoe3d.cli.parts import Number, configuration_options, sensor_place, unit_option
from geomoe3d.runtime.words import of_the_score

if TYPE_CHECKING:
    from geomoe3d.config import RegistrationConfig
    from geomoe3d.maps.location import Location
    from geomoe3d.types import FloatArray

Form = Literal["text", "json", "quiet"]

_NEXT = {
    "low_confidence": "check the place before you use it; where the scanner stood, roughly (--near X,Y,Z --within "
    "LENGTH), or a scan that sees more can make it sure",
    "ambiguous": "where the scanner stood, roughly (--near X,Y,Z --within LENGTH), or a scan that sees more can tell "
    "the places apart",
    "failed": "make sure that the scan was taken in this map, and that both are in one unit; where the scanner stood "
    "(--sensor X,Y,Z in the scan, --near X,Y,Z in the map) can help",
}
"""What to do, by status."""


@click.command(cls=Verb, context_settings=HELP, short_help="Find scans in a map, and say how sure.")
@click.argument("inputs", metavar="SCANS... MAP", nargs=-1, required=True)
@configuration_options
@click.option(
    "-k",
    "--places",
    metavar="N",
    type=Number(1),
    default=3,
    show_default=True,
    help="Most candidate places to list.",
)
@click.option(
    "--near",
    metavar="X,Y,Z",
    help="Roughly where the scanner stood, in the map's coordinates; of a scan that does not show where that was (give "
    "--sensor) where its middle lies.",
)
@click.option(
    "--within",
    type=Number(above=0, whole=False),
    metavar="LENGTH",
    help="How far off --near may be, in the unit of the map.",
)
@click.option(
    "--initial", metavar="FILE", help="A first guess of the transform, as of `register`; one scan only."
)
@click.option(
    "--sensor",
    metavar="X,Y,Z",
    help="Where the scanner of each scan stood, in the scan's own coordinates; 'none': at no single place. [found]",
)
@unit_option
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON per scan and nothing else.")
@click.option(
    "--output", metavar="FILE.tum", help="Write the poses that are ok as TUM text, one line per scan."
)
@click.option("--force", is_flag=True, help="Replace an output file that exists.")
@click.option(
    "--quiet",
    is_flag=True,
    help="Print the four rows of the matrix alone (of several scans nothing: give --output), and one line of warning "
    "for each scan that is not ok.",
)
@part_option("reader")
@traceback_option
@click.pass_context
def command(
    context: click.Context,
    inputs: tuple[str, ...],
    config: RegistrationConfig,
    places: int,
    near: str | None,
    within: float | None,
    initial: str | None,
    sensor: str | None,
    unit: str,
    as_json: bool,
    output: str | None,
    force: bool,
    quiet: bool,
) -> None:
    """Find SCANS (files, or folders of them) in MAP: p_map = R p_scan + t.

    MAP is what `geomoe3d index` wrote, or a cloud, which is then indexed first. Exit code 0 if all are ok, 3 if
    not, 2 for unusable input. A place that is given by --near is looked at first and checked, not trusted.
    """
    if len(inputs) < 2:
        raise click.UsageError("give at least one scan, and the map last")
    maps = [name for name in inputs[:-1] if is_map(name)]
    if maps:
        others = [name for name in inputs if name != maps[0]]
        if is_map(others[-1]):
            raise click.UsageError(f"'{maps[0]}' and '{others[-1]}' are maps: give one map, behind the scans")
        raise use_instead(f"'{maps[0]}' is a map, and the map comes last, behind the scans", *others, maps[0])
    if Path(inputs[-1]).is_dir() and not is_map(inputs[-1]):
        raise click.UsageError(
            f"the map comes last, and '{inputs[-1]}' is a folder; make a map of its clouds: geomoe3d index "
            f"{shlex.quote(inputs[-1])} NAME.map"
        )
    from geomoe3d.cli.progress import stage_display, stdout_to_stderr

    with stdout_to_stderr(), stage_display(quiet) as stage:
        stage("start")
        from geomoe3d.clouds.transform_files import load_transform
        from geomoe3d.errors import InputError
        from geomoe3d.maps.map import Map
        from geomoe3d.multiway.scans import find_clouds

        scans = find_clouds(inputs[:-1])
        read = [*(scan.path for scan in scans), inputs[-1], *filter(None, [initial])]
        check_outputs([("--output", output, (".tum", ".txt"))], [str(path) for path in read], force)
        if initial is not None and len(scans) > 1:
            raise click.UsageError(f"--initial is a guess of one scan, found {len(scans)}")
        guess = None if initial is None else load_transform(initial)
        prior, stood = None if near is None else _numbers(near), sensor_place(sensor, "--sensor")
        if is_map(inputs[-1]):
            within_map = Map.open(inputs[-1], config=config)
        else:
            within_map = Map.from_cloud(inputs[-1], config=config, progress=stage)
    form: Form = "json" if as_json else "quiet" if quiet else "text"
    found: list[tuple[str, Location | None]] = []
    begin = time.monotonic()
    for scan in scans:
        try:
            with stdout_to_stderr(), stage_display(quiet) as stage:
                location = within_map.locate(
                    scan.path,
                    k=places,
                    near=prior,
                    within=within,
                    initial=guess,
                    sensor=stood,
                    progress=stage,
                )
        except InputError as error:
            if len(scans) == 1:
                raise
            click.echo(f"{scan.name}: {error}", err=True)
            location = None
        found.append((scan.name, location))
        if location is not None:
            _print(scan.name, location, form, len(scans) == 1, unit)
    if len(scans) > 1 and form == "text":
        sure = sum(location is not None and location.ok for _, location in found)
        rate = len(scans) / max(time.monotonic() - begin, 1e-9)
        click.echo(f"{sure} of {len(scans)} ok; {rate:.2f} scans per second")
    if form == "text":
        doubted = {location.status for _, location in found if location is not None} & _NEXT.keys()
        for number, status in enumerate(status for status in _NEXT if status in doubted):
            named = f" ({status.replace('_', ' ')})" if len(scans) > 1 else ""
            click.echo(f"{'' if number else chr(10)}next{named}: {_NEXT[status]}")
    if output is not None:
        _write(output, found, force)
    if any(location is None for _, location in found):
        context.exit(ExitCode.BAD_INPUT)
    sure = all(location is not None and location.ok for _, location in found)
    context.exit(ExitCode.OK if sure else ExitCode.NOT_SURE)


def _numbers(text: str) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise click.UsageError(f"--near is '{text}', expected X,Y,Z: three numbers with commas between")
    return numbers


def _print(name: str, location: Location, form: Form, alone: bool, unit: str) -> None:
    """One scan's answer; ``alone``: it is the only scan."""
    from geomoe3d.cli.summary import print_quietly, summary

    result = location.result
    if form == "json":
        click.echo(json.dumps({"scan": name, **json.loads(location.to_json(None))}))
    elif form == "quiet":
        print_quietly(result, matrix=alone, name="" if alone else name)
    elif alone:
        click.echo(summary(result, unit=unit), color=False if os.environ.get("NO_COLOR") else None)
        for number, place in enumerate(location.places[1:], start=2):
            click.echo(
                f"place {number}: at {_at(place.T_map_scan, unit)}, {of_the_score(place.relative_score)}"
            )
    else:
        reason = f"; {result.reasons[0]}" if result.reasons else ""
        at = "" if location.status == "failed" else f" at {_at(location.T_map_scan, unit)}"
        click.echo(f"{name}: {location.status} (confidence {result.confidence:.2f}){at}{reason}")


def _at(T_map_scan: FloatArray, unit: str) -> str:
    return " ".join(f"{value:.3f}" for value in T_map_scan[:3, 3]) + f" {unit}".rstrip()


def _write(path: str, found: Sequence[tuple[str, Location | None]], force: bool) -> None:
    """Poses of the scans that are ok, and a remark for each of the others."""
    from geomoe3d.multiway.formats import tum_text
    from geomoe3d.runtime.files import write_text

    sure = [(name, number, x.T_map_scan) for number, (name, x) in enumerate(found) if x is not None and x.ok]
    text = tum_text([name for name, _, _ in sure], [n for _, n, _ in sure], [T for _, _, T in sure])
    for number, (name, location) in enumerate(found):
        if location is None or not location.ok:
            text += f"# {number} {' '.join(name.split())}: {'unusable' if location is None else location.status}\n"
    write_text(path, text, force=force)
