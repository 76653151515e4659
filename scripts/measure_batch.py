"""Batches under fire: workers killed again and again, and pairs per minute with one and two workers.

    python scripts/measure_batch.py OUT [--pairs 500] [--kill-every 50] [--throughput 40] [--points 3000]

Pairs are of generated scans (boxes turned every way), about 3,000 points each, 0.12 voxels: 0.1 to 0.2 s of
one core. The first part runs the command with two workers and kills one of them after every 50 pairs; in the
end every pair must be in the journal once, and results.jsonl must hold the bytes of a run in which nobody
dies. The second part measures pairs per minute with 1 and with 2 workers, descriptions being kept already.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from geomoe3d.geometry.se3 import project_to_so3
from geomoe3d.runtime.journal import read_journal
from geomoe3d.runtime.provenance import hardware
from geomoe3d.types import FloatArray

_SETTINGS = ("voxel_size=0.12", "preparation.viewpoint=centroid", "matching.max_correspondences=400")
_NUM_SCANS = 24


def make_scans(folder: Path, num_points: int) -> list[str]:
    """Parts of one scene as .npy files."""
    rng = np.random.default_rng(0)
    faces = []
    for _ in range(30):
        R, centre, size = random_rotation(rng), rng.uniform(0, 6, 3), rng.uniform(0.3, 1.2, 3)
        points = rng.uniform(-0.5, 0.5, (1200, 3))
        axis = rng.integers(0, 3, 1200)
        points[np.arange(1200), axis] = rng.choice([-0.5, 0.5], 1200)
        faces.append((points * size) @ R.T + centre)
    scene = np.concatenate(faces)
    names = []
    for number in range(_NUM_SCANS):
        low = rng.uniform(0, 3)
        part = scene[(scene[:, 0] > low) & (scene[:, 0] < low + 3)]
        part = part[rng.permutation(len(part))[:num_points]]
        names.append(f"scan_{number}.npy")
        np.save(folder / names[-1], part @ random_rotation(rng).T)
    return names


def random_rotation(rng: np.random.Generator) -> FloatArray:
    return project_to_so3(rng.normal(size=(3, 3)))


def write_table(path: Path, names: list[str], count: int) -> None:
    pairs = [(a, b) for a in names for b in names if a != b][:count]
    lines = ["id,source,target", *(f"{k},{a},{b}" for k, (a, b) in enumerate(pairs))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def start(table: Path, out: Path, workers: int) -> subprocess.Popen[bytes]:
    options = [part for setting in _SETTINGS for part in ("--set", setting)]
    command = [sys.executable, "-m", "geomoe3d", "batch", str(table), str(out), "--workers", str(workers)]
    return subprocess.Popen(
        [*command, *options, "--quiet", "--cache", str(out.parent / "cache")], stderr=subprocess.DEVNULL
    )


def done_pairs(out: Path) -> int:
    journal = out / "journal.jsonl"
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def workers_of(process: subprocess.Popen[bytes]) -> list[int]:
    """Processes started by the command that work on pairs (not the one that tracks resources)."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text(encoding="ascii").split()
    found = []
    for child in children:
        try:
            line = Path(f"/proc/{child}/cmdline").read_bytes()
        except OSError:
            continue
        if b"spawn_main" in line:
            found.append(int(child))
    return found


def under_fire(folder: Path, table: Path, every: int) -> None:
    out = folder / "killed"
    process, kills, mark = start(table, out, 2), 0, every
    while process.poll() is None:
        if done_pairs(out) >= mark:
            workers = workers_of(process)
            if workers:
                os.kill(workers[-1], signal.SIGKILL)
                kills, mark = kills + 1, mark + every
        time.sleep(0.05)
    ids = [record["id"] for record in read_journal(out / "journal.jsonl")]
    wanted = {line.split(",")[0] for line in table.read_text(encoding="utf-8").splitlines()[1:]}
    print(
        f"{len(wanted)} pairs, {kills} workers killed: {len(wanted - set(ids))} lost, "
        f"{len(ids) - len(set(ids))} twice, exit code {process.returncode}",
        flush=True,
    )
    calm = folder / "calm"
    start(table, calm, 1).wait()
    same = (calm / "results.jsonl").read_bytes() == (out / "results.jsonl").read_bytes()
    print(f"the same bytes as one worker that nobody killed: {'yes' if same else 'NO'}", flush=True)


def throughput(folder: Path, table: Path) -> None:
    count = len(table.read_text(encoding="utf-8").splitlines()) - 1
    start(table, folder / "warm", 1).wait()
    for workers in (1, 2):
        out = folder / f"workers{workers}"
        process = start(table, out, workers)
        while process.poll() is None and done_pairs(out) < 4:  # starting Python and its libraries
            time.sleep(0.02)
        begin, before = time.perf_counter(), done_pairs(out)
        process.wait()
        rate = 60 * (count - before) / (time.perf_counter() - begin)
        print(f"{workers} worker{'s' * (workers > 1)}: {rate:.0f} pairs per minute", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--kill-every", type=int, default=50)
    parser.add_argument(
        "--throughput", type=int, default=40, help="pairs of the second part; 0 leaves it out"
    )
    parser.add_argument("--points", type=int, default=3000, help="per scan")
    given = parser.parse_args()
    folder = Path(given.out)
    folder.mkdir(parents=True)
    names = make_scans(folder, given.points)
    print(hardware())
    if given.pairs:
        write_table(folder / "pairs.csv", names, given.pairs)
        under_fire(folder, folder / "pairs.csv", given.kill_every)
    if given.throughput:
        write_table(folder / "few.csv", names, given.throughput)
        throughput(folder, folder / "few.csv")


if __name__ == "__main__":
    main()
