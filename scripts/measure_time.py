"""How long a registration takes, and where: beside other methods, beside another state of the code, and from the shell.

    python scripts/measure_time.py --every 24 [--first 12] [--beside CHECKOUT]
    python scripts/measure_time.py SOURCE TARGET [--repeats 5]
    python scripts/measure_time.py --million 5 [--beside CHECKOUT] [--repeats 3]
    python scripts/measure_time.py --world FOLDER [--repeats 3]

The first runs every 24th pair of 3DMatch and 3DLoMatch end to end beside KISS-Matcher, and on 1,000 correspondences
beside Open3D's RANSAC, each in a warm process of its own and in turn pair by pair, so that a busy machine slows all
alike: the ratios count, not the milliseconds. The second is the command ``register`` beside a script that reads the
same files with Open3D and calls KISS-Matcher with voxels of 5 cm, with the imports that cost most; the third two
generated clouds of so many points; the fourth every pair ``*_s.ply``, ``*_t.ply`` of a folder beside KISS-Matcher with
voxels half as wide as ours, both in this process, in turn, from arrays. Processor time, user and system together, says
more than the clock where other jobs run.
"""

from __future__ import annotations

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from geomoe3d import Registrar, load_points
from geomoe3d.clouds.io import save_points
from geomoe3d.data.sample import make_sample_pair

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


PEERS = (("geomoe3d", "clouds", "kiss-matcher"), ("geomoe", "1k", "open3d-ransac-50k"))
NUM_PAIRS = {"3DMatch": 843, "3DLoMatch": 1044}


class Run(NamedTuple):
    """One process: seconds by the clock and of the processor, and the most memory that it held."""

    wall: float
    cpu: float
    mib: float


@click.command()
@click.argument("clouds", nargs=-1, type=click.Path(exists=True, dir_okay=False))
@click.option(
    "--repeats", default=5, show_default=True, help="Processes of each kind, for SOURCE and TARGET."
)
@click.option(
    "--every", default=0, help="Every so many pairs of both benchmarks, beside other methods. [none]"
)
@click.option("--first", default=0, show_default=True, help="The first of these pairs.")
@click.option(
    "--beside", type=click.Path(exists=True, file_okay=False), help="Another checkout, run in turn."
)
@click.option("--million", default=0.0, help="Points of two large clouds, in millions. [none]")
@click.option(
    "--world", "folder", type=click.Path(exists=True, file_okay=False), help="Folder of pairs. [none]"
)
def main(
    clouds: tuple[str, ...],
    repeats: int,
    every: int,
    first: int,
    beside: str | None,
    million: float,
    folder: str | None,
) -> None:
    """Print what was asked for; see the top of the file."""
    print(f"{os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}")
    if clouds:
        source, target = clouds
        shell(source, target, repeats)
    if every:
        for name, track, peer in PEERS:
            workers = {"geomoe3d": Worker(name, track), peer: Worker(peer, track)}
            if beside is not None:
                workers["beside"] = Worker(name, track, beside)
            for benchmark, count in NUM_PAIRS.items():
                compare(f"{benchmark}, {track}, {name}", workers, benchmark, range(first, count, every))
    if million:
        large(million, beside, repeats)
    if folder is not None:
        world(Path(folder), repeats)


def shell(source: str, target: str, repeats: int) -> None:
    """Start-up beside KISS-Matcher's, and the dearest imports."""
    runs: dict[str, list[Run]] = {name: [] for name in COMMANDS}
    for _ in range(repeats):
        for name, command in COMMANDS.items():
            runs[name].append(measure([*command, source, target]))
    _table({name: _middle(some) for name, some in runs.items()}, f"medians of {repeats}")
    imports([*COMMANDS["geomoe3d register"], source, target])


def large(million: float, beside: str | None, repeats: int) -> None:
    """The sample pair, its points repeated with 5 mm of noise, from the shell, beside another checkout where there is
    one."""
    with tempfile.TemporaryDirectory() as folder:
        names = [f"{folder}/{name}.ply" for name in ("source", "target")]
        for seed, (name, cloud) in enumerate(zip(names, make_sample_pair()[:2], strict=True)):
            rng = np.random.default_rng(seed)
            rows = rng.integers(0, len(cloud), round(1e6 * million))
            save_points(name, cloud.file_points[rows] + rng.normal(0, 0.005, (len(rows), 3)))
        command = COMMANDS["geomoe3d register"]
        runs: dict[str, list[Run]] = {}
        for _ in range(repeats):
            for name, checkout in (("geomoe3d", None), ("beside", beside)):
                if name == "geomoe3d" or checkout is not None:
                    runs.setdefault(name, []).append(measure([*command, *names], checkout))
    _table({name: _middle(some) for name, some in runs.items()}, f"two of {million:g} million points")


def world(folder: Path, repeats: int) -> None:
    """A row per pair: seconds by the clock and of the processor, medians, beside KISS-Matcher's at half our voxel."""
    import kiss_matcher

    registrar, ratios = Registrar(), []
    print(f"\n{'pair':24} {'voxel':>7} {'geomoe3d':>14} {'KISS-Matcher':>14} {'ratio':>12}  status")
    for source in sorted(folder.glob("*_s.ply")):
        target = source.with_name(source.name.replace("_s.ply", "_t.ply"))
        if not target.exists():
            continue
        loaded = [load_points(path) for path in (source, target)]
        given, near_zero = [cloud.file_points for cloud in loaded], [cloud.points for cloud in loaded]
        answer = registrar.register(*given)
        config = kiss_matcher.KISSMatcherConfig(answer.voxel_size / 2)
        taken = []
        for _ in range(repeats):
            ours = _timed(registrar.register, *given)
            taken.append([*ours, *_timed(kiss_matcher.KISSMatcher(config).estimate, *near_zero)])
        wall, cpu, their_wall, their_cpu = (float(x) for x in np.median(taken, axis=0))
        ratios.append((wall / their_wall, cpu / their_cpu))
        print(
            f"{source.name[:-6]:24} {answer.voxel_size:7.3g} {wall:7.2f} {cpu:6.2f} {their_wall:7.2f} {their_cpu:6.2f} "
            f"{ratios[-1][0]:6.2f} {ratios[-1][1]:5.2f}  {answer.status}",
            flush=True,
        )
    clock, processor = np.median(ratios, axis=0)
    print(f"{'median of the ratios':63} {clock:6.2f} {processor:5.2f}")


def _timed(call: Callable[..., object], *given: object) -> tuple[float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    call(*given)
    return time.perf_counter() - wall, time.process_time() - cpu


def _middle(runs: list[Run]) -> Run:
    return Run(*(statistics.median(values) for values in zip(*runs, strict=True)))


def _table(middle: dict[str, Run], title: str) -> None:
    print(f"\n{title:24} {'clock':>8} {'processor':>10} {'memory':>10}")
    for name, run in middle.items():
        print(f"{name:24} {run.wall:6.2f} s {run.cpu:8.2f} s {run.mib:6.0f} MiB")
    if len(middle) == 2:
        ratios = [a / b for a, b in zip(*middle.values(), strict=True)]
        print(f"{'ratio':24} {ratios[0]:8.2f} {ratios[1]:10.2f} {ratios[2]:10.2f}")


class Worker:
    """A method of the evaluation in a process of its own, warm after its first pair."""

    def __init__(self, method: str, track: str, checkout: str | None = None) -> None:
        self._name = method
        script = str(Path(__file__).with_name("time_worker.py"))
        more = [] if checkout is None else [str(Path(checkout).resolve())]
        command = [sys.executable, script, method, track, *more]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True
        )

    def __call__(self, benchmark: str, number: int) -> dict[str, Any]:
        """What one pair took.

        Raises:
            SystemExit: the process has ended.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{benchmark} {number}\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"the process of {self._name} ended")
        found: dict[str, Any] = json.loads(line)
        return found


def compare(title: str, workers: dict[str, Worker], benchmark: str, numbers: range) -> None:
    """Run the same pairs by all, one after the other, and print medians, ratios to ours and times of stages."""
    for worker in workers.values():
        worker(benchmark, numbers[0])  # loads libraries, fills caches
    taken: dict[str, list[dict[str, Any]]] = {name: [] for name in workers}
    for number in numbers:
        for name, worker in workers.items():
            taken[name].append(worker(benchmark, number))
    ours = taken["geomoe3d"]
    print(f"\n{title}, {len(numbers)} pairs, medians, ms: clock, processor; ours over it; its stages")
    for name, runs in taken.items():
        words = [f"{name:20}"]
        for clock in ("wall", "cpu"):
            words.append(f"{1000 * statistics.median(run[clock] for run in runs):6.0f}")
        for clock in ("wall", "cpu"):
            theirs = statistics.median(run[clock] for run in runs)
            words.append(f"{statistics.median(run[clock] for run in ours) / theirs:6.2f}")
        print("  ".join(words), _stages([run["stages"] for run in runs]), sep="  ")


def _stages(found: list[dict[str, float]]) -> str:
    """Mean over all pairs, since most stages of a second look are not every pair's."""
    names = list(dict.fromkeys(name for stages in found for name in stages))
    means = {name: statistics.fmean(stages.get(name, 0.0) for stages in found) for name in names}
    return ", ".join(f"{name} {1000 * seconds:.0f}" for name, seconds in means.items())


def measure(command: list[str], checkout: str | None = None) -> Run:
    """Run a command to its end, with another checkout's package where one is given.

    Raises:
        SystemExit: it fails otherwise than by saying that an answer is not reliable.
    """
    begin = time.perf_counter()
    known = os.environ if checkout is None else {**os.environ, "PYTHONPATH": checkout}
    nowhere = subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=nowhere, stderr=nowhere, env=known)
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


if __name__ == "__main__":
    main()
