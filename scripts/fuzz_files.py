"""Reads damaged files of every kind for a while: no crash, hang, other error or hunger for memory.

    python scripts/fuzz_files.py --minutes 20

Valid files of every readable format, and transforms, are damaged at random: bits, numbers, lines, lengths.
Each is read in a process that is watched from outside. What fails is kept in the folder given by --keep, with
the reason. Exit code 1 if anything failed. Not part of the test suite; it needs the `tests` folder of this
checkout.
"""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import random
import re
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

LONGEST_SECONDS = 10.0
MEMORY_FACTOR, MEMORY_SLACK = 10, 96 << 20  # of the file's size, and bytes besides for libraries
CELLS = {
    version: f"# vtk DataFile Version {version}\nx\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n0 0 0 1 0 0 1 1 0 0 1 0\n"
    + cells
    for version, cells in (
        ("3.0", "POLYGONS 2 9\n4 0 1 2 3\n3 0 1 2\nTRIANGLE_STRIPS 1 5\n4 0 1 3 2\nLINES 1 3\n2 0 1\n"),
        ("5.1", "POLYGONS 3 7\nOFFSETS vtktypeint64\n0 4 7\nCONNECTIVITY vtktypeint64\n0 1 2 3 0 1 2\n"),
    )
}
NUMBERS = (b"0", b"-1", b"1", b"255", b"65536", b"2147483648", b"99999999999", b"1e999", b"nan", b"0.5", b"")


def damaged(data: bytes, rng: random.Random) -> bytes:
    """A copy with one to four damages."""
    for _ in range(rng.randint(1, 4)):
        if not data:
            break
        reach = min(len(data), rng.choice((300, 2000, len(data))))
        place, size = rng.randrange(reach), rng.choice((1, 2, 4, 8))
        kind = rng.randrange(7)
        if kind == 0:
            data = data[:place] + bytes([rng.randrange(256)]) + data[place + 1 :]
        elif kind == 1:
            data = data[: rng.randrange(len(data))]
        elif kind == 2:
            value = rng.choice((0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1, rng.getrandbits(16)))
            data = data[:place] + (value % 256**size).to_bytes(size, "little") + data[place + size :]
        elif kind == 3:
            runs = list(re.finditer(rb"-?\d+(\.\d+)?", data[:reach]))
            if runs:
                run = rng.choice(runs)
                data = data[: run.start()] + rng.choice(NUMBERS) + data[run.end() :]
        elif kind == 4:
            lines = data.split(b"\n")
            lines.insert(rng.randrange(len(lines)), lines.pop(rng.randrange(len(lines))))
            data = b"\n".join(lines)
        elif kind == 5:
            data = data[:place] + data[place : place + rng.randrange(200)] * 2 + data[place:]
        else:
            data = data[:place] + data[place + size :]
    return data


def read(path: Path) -> None:
    """What a user does with a file; errors that are promised are no failure."""
    import numpy as np

    from geomoe3d.clouds.io import load_points, save_aligned
    from geomoe3d.clouds.transform_files import load_transform
    from geomoe3d.errors import GeoMoE3DError

    try:
        if path.name.startswith("transform"):
            load_transform(path)
            return
        load_points(path, mesh_points=50)
        if path.stat().st_size % 4 == 0:
            suffix = {".obj": ".obj", ".glb": ".glb"}.get(path.suffix, ".ply")
            save_aligned(path.with_name(f"aligned{suffix}"), path, np.eye(4), force=True)
    except GeoMoE3DError:
        pass


def work(samples: dict[str, bytes], seed: int, folder: Path, to: Connection) -> None:
    """Damage and read without end; says what comes next, and what went wrong."""
    rng = random.Random(seed)
    for name, data in samples.items():  # libraries are loaded before memory is counted
        (folder / name).write_bytes(data)
        read(folder / name)
    while True:
        name = rng.choice(sorted(samples))
        data = damaged(samples[name], rng)
        path = folder / name
        path.write_bytes(data)
        to.send(("next", name, ""))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            read(path)
        except BaseException:
            to.send(("failed", name, traceback.format_exc()))
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
        if grown > MEMORY_FACTOR * len(data) + MEMORY_SLACK:
            to.send(("failed", name, f"{grown / 1e6:.0f} MB for a file of {len(data)} bytes"))


def make_samples() -> dict[str, bytes]:
    """One or more valid files of every format."""
    import numpy as np

    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    cloud_files: Any = importlib.import_module("cloud_files")
    io: Any = importlib.import_module("geomoe3d.clouds.io")
    transforms: Any = importlib.import_module("geomoe3d.clouds.transform_files")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for suffix in io.READABLE_SUFFIXES:
            if suffix != ".gltf":
                cloud_files.write_full(folder / f"a{suffix}")
        for mode in ("ascii", "binary_compressed"):
            (folder / f"{mode}.pcd").write_bytes(cloud_files.pcd(60, 60, mode))
        (folder / "ascii.ply").write_bytes(cloud_files.ply(60, 60))
        io.save_aligned(folder / "mesh.ply", folder / "a.obj", np.eye(4))
        trimesh: Any = importlib.import_module("trimesh")
        exported = trimesh.exchange.gltf.export_gltf(
            trimesh.Scene(trimesh.creation.box()), embed_buffers=True
        )
        (folder / "embedded.gltf").write_bytes(exported["model.gltf"])
        for version in ("3.0", "5.1"):
            (folder / f"cells-{version}.vtk").write_text(CELLS[version])
        for kind in transforms.TRANSFORM_FORMATS:
            if kind != "json":
                transforms.save_transform(
                    f"{kind}:{folder / f'transform.{kind}'}", cloud_files.rigid(), [kind]
                )
        return {path.name: path.read_bytes() for path in folder.iterdir()}


def main() -> int:
    """Run, report, and say how many files were read."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"), help="folder for files that failed")
    options = parser.parse_args()
    samples = make_samples()
    end = time.monotonic() + 60 * options.minutes
    done, failures, seed = 0, 0, options.seed
    context = multiprocessing.get_context("spawn")

    def keep(folder: Path, name: str, reason: str) -> None:
        nonlocal failures
        path = folder / name
        failures += 1
        options.keep.mkdir(parents=True, exist_ok=True)
        (options.keep / f"{failures:03d}-{path.name}").write_bytes(path.read_bytes())
        (options.keep / f"{failures:03d}-{path.name}.reason").write_text(reason)
        print(f"{path.name}: {reason.strip().splitlines()[-1]}", flush=True)

    while time.monotonic() < end:
        with tempfile.TemporaryDirectory() as name:
            here, there = context.Pipe(duplex=False)
            process = context.Process(target=work, args=(samples, seed, Path(name), there), daemon=True)
            process.start()
            there.close()
            done += watch(process, here, end, partial(keep, Path(name)))
        seed += 1
    print(f"{done:,} files read in {options.minutes:g} minutes, {failures} failed")
    return 1 if failures else 0


def watch(process: Any, here: Connection, end: float, keep: Callable[[str, str], None]) -> int:
    """Follow a process until time is up or it is of no use any more; how many files it read."""
    done, current = 0, ""
    while True:
        try:
            if not here.poll(LONGEST_SECONDS if current else 120.0):
                keep(current, f"no answer within {LONGEST_SECONDS:g} s") if current else None
                break
            kind, name, reason = here.recv()
        except EOFError:
            process.join()
            if current:
                keep(current, f"the process ended with {process.exitcode}")
            return done
        if kind == "failed":
            keep(name, reason)
        else:
            done, current = done + 1, name
        if time.monotonic() > end:
            break
    process.kill()
    process.join()
    return done


if __name__ == "__main__":
    sys.exit(main())
