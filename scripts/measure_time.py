"""How long `register a.ply b.ply` takes from the shell, and how much memory, beside a script of KISS-Matcher.

    python scripts/measure_time.py SOURCE TARGET [--repeats 5] [--pairs PAIRS --fragments FOLDER]

Both run as processes of their own, in turn, so that a busy machine slows both alike: the ratios count, not
the seconds. KISS-Matcher's script reads the files with Open3D and registers with voxels of 5 cm. Processor
time, user and system together, says more than the clock where other jobs run. Then the seconds of every stage,
medians over pairs registered one after the other in one process that is warm, and where start-up goes: the
dearest imports.
"""

from __future__ import annotations

import itertools
import os
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import click

KISS_MATCHER = """
import sys
import kiss_matcher, numpy as np, open3d as o3d
source, target = (np.asarray(o3d.io.read_point_cloud(name).points) for name in sys.argv[1:])
answer = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(0.05)).estimate(source, target)
print(np.array(answer.rotation), np.array(answer.translation))
"""
COMMANDS = {
    "geomoe3d register": [sys.executable, "-m", "geomoe3d", "register"],
    "KISS-Matcher script": [sys.executable, "-c", KISS_MATCHER],
}


class Run(NamedTuple):
    """One process: seconds by the clock and of the processor, and the most memory that it held."""

    wall: float
    cpu: float
    mib: float


@click.command()
@click.argument("source", type=click.Path(exists=True, dir_okay=False))
@click.argument("target", type=click.Path(exists=True, dir_okay=False))
@click.option("--repeats", default=5, show_default=True, help="Processes of each kind.")
@click.option("--folder", type=click.Path(exists=True, file_okay=False), help="Clouds for stage times.")
@click.option("--pairs", default=10, show_default=True, help="Neighbours in the folder that are registered.")
def main(source: str, target: str, repeats: int, folder: str | None, pairs: int) -> None:
    """Print start-up beside KISS-Matcher's, the dearest imports, and stage times."""
    print(f"{os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}")
    runs: dict[str, list[Run]] = {name: [] for name in COMMANDS}
    for _ in range(repeats):
        for name, command in COMMANDS.items():
            runs[name].append(measure([*command, source, target]))
    middle = {
        name: Run(*(statistics.median(values) for values in zip(*some, strict=True)))
        for name, some in runs.items()
    }
    print(f"\n{'medians of ' + str(repeats):24} {'clock':>8} {'processor':>10} {'memory':>10}")
    for name, run in middle.items():
        print(f"{name:24} {run.wall:6.2f} s {run.cpu:8.2f} s {run.mib:6.0f} MiB")
    ours, theirs = middle.values()
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
    print(f"{'ratio':24} {ratios[0]:8.2f} {ratios[1]:10.2f} {ratios[2]:10.2f}")
    imports([*COMMANDS["geomoe3d register"], source, target])
    if folder is not None:
        stages(sorted(Path(folder).glob("*.ply"))[: pairs + 1])


def measure(command: list[str]) -> Run:
    """Run a command to its end.

    Raises:
        SystemExit: it fails otherwise than by saying that an answer is not reliable.
    """
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    wall = time.perf_counter() - begin
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):
        raise SystemExit(f"{command[1:4]} failed with status {process.returncode}")
    return Run(wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def imports(command: list[str], most: int = 15) -> None:
    """Print the packages whose modules cost most to import, each counted by itself."""
    timed = [command[0], "-X", "importtime", *command[1:]]
    lines = subprocess.run(timed, capture_output=True, text=True, check=False).stderr.splitlines()
    own: dict[str, float] = {}
    for line in lines:
        if match := re.match(r"import time:\s+(\d+) \|\s+\d+ \|\s*(\w+)", line):
            own[match[2]] = own.get(match[2], 0.0) + float(match[1]) / 1000
    total = sum(own.values())
    print(f"\nimports, ms by package in one process of geomoe3d, {total:.0f} in all:")
    dearest = sorted(own.items(), key=lambda item: -item[1])[:most]
    print("  " + ", ".join(f"{name} {ms:.0f}" for name, ms in dearest))


def stages(clouds: list[Path]) -> None:
    """Print medians of stage times over neighbours in a list of files."""
    import geomoe3d

    registrar = geomoe3d.Registrar()
    registrar.register(clouds[0], clouds[1])
    found: dict[str, list[float]] = {}
    for one, other in itertools.pairwise(clouds):
        for stage, seconds in registrar.register(other, one).seconds.items():
            found.setdefault(stage, []).append(seconds)
    print(f"\nstages, medians of {len(clouds) - 1} pairs in one warm process, ms:")
    print("  " + ", ".join(f"{stage} {1000 * statistics.median(s):.0f}" for stage, s in found.items()))


if __name__ == "__main__":
    main()
