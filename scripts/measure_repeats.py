"""Places that look alike elsewhere: how often is a wrong answer called ok?

    python scripts/measure_repeats.py OUT [--count 36] [--seed 11] [--every 1] [--set KEY=VALUE ...]

Rooms are generated in turn that look alike after a half turn or a quarter turn, with rows of equal desks or shelves,
corridors of equal doors, and two equal rooms that open to one another; with none, two or eight small things that tell
one place from the other. Each is scanned four times by a scanner on a tripod or a spinning one. An answer is right
within 15 degrees and 0.3 m. Truth scores, nothing else. Lines go to OUT/repeats.jsonl as pairs are finished; called
again, the command goes on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np

from geomoe3d.config import load_config
from geomoe3d.data.fusion import thin
from geomoe3d.data.rooms import clutter, seats, storage
from geomoe3d.data.rooms.scanner import SPINNING, TRIPOD, LaserScanner, stand_scanner
from geomoe3d.data.rooms.scenes import Scene
from geomoe3d.data.rooms.solids import Solids, pose_on_floor, turn
from geomoe3d.evaluation.metrics import is_right, motion_errors
from geomoe3d.geometry.se3 import inverse
from geomoe3d.registration import Registrar
from geomoe3d.types import FloatArray

KINDS = ("half turn", "quarter turn", "desks", "corridor", "two rooms", "shelves")
SMALL_THINGS = (0, 2, 8)
SCANNERS = (TRIPOD.model_copy(update={"rings": 150, "azimuth_step_deg": 1.0}), SPINNING)
ALONG_WALLS = (
    storage.wardrobe,
    storage.chest,
    storage.bookshelf,
    seats.sofa,
    seats.desk,
    seats.bed,
    storage.boxes,
    storage.plant,
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=36, help="places")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--every", type=int, default=1, help="every so many pairs")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "repeats.jsonl"
    done = {r["name"]: r for r in map(json.loads, path.read_text().splitlines())} if path.exists() else {}
    registrar, number = Registrar(load_config(None, given.settings)), 0
    with path.open("a") as file:
        for place in range(given.count):
            scans = list(recorded(place, given.seed))
            for i, j in combinations(range(len(scans)), 2):
                number += 1
                name = f"{place}/{i}-{j}"
                if number % given.every or name in done:
                    continue
                (source, first), (target, second) = scans[i], scans[j]
                result = registrar.register(source, target)
                turned, shifted = motion_errors(result.T_target_source, inverse(second) @ first)
                done[name] = {
                    "name": name,
                    "kind": KINDS[place % len(KINDS)],
                    "right": is_right(turned, shifted),
                    "status": result.status,
                    "confidence": result.confidence,
                    "rotation_error_deg": turned,
                    "translation_error": shifted,
                }
                file.write(json.dumps(done[name]) + "\n")
                file.flush()
    for kind in (*KINDS, "all"):
        lines = [line for line in done.values() if kind in (line["kind"], "all")]
        accepted = [line for line in lines if line["status"] == "ok"]
        print(
            f"{kind:12s} {len(lines):4d} pairs, right {sum(line['right'] for line in lines)}, ok {len(accepted)}, "
            f"wrong and ok {sum(not line['right'] for line in accepted)}"
        )


def recorded(number: int, seed: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Scans of one place (n, 3), each in its sensor's frame, and its pose."""
    rng, six = np.random.default_rng((seed, number)), len(KINDS)
    scene = made(KINDS[number % six], rng, SMALL_THINGS[number // six % 3])
    scanner = LaserScanner(SCANNERS[number // (3 * six) % 2])
    for pose in stand_scanner(rng, scene, 4):
        yield thin(scanner.scan(scene.rays, pose, rng), 0.025), pose


def made(kind: str, rng: np.random.Generator, small_things: int) -> Scene:
    """A place of a kind."""
    s = Solids()
    if kind == "corridor":
        w, d = rng.uniform(1.8, 2.6), rng.uniform(10, 16)
        shell(s, w, d)
        step = rng.uniform(1.8, 2.6)
        for y in np.arange(step / 2, d - 0.5, step).tolist():
            for x in (-0.02, w - 0.06):
                s.box((x, y - 0.5, 0), (0.08, 0.06, 2.1))
                s.box((x, y + 0.45, 0), (0.08, 0.06, 2.1))
                s.box((x, y - 0.5, 2.05), (0.08, 1.0, 0.06))
    elif kind == "two rooms":
        w, d = rng.uniform(3, 4.5), rng.uniform(3.5, 5)
        half, table, angle = along_walls(rng, w, d), table_with_chairs(rng), float(rng.uniform(0, 90))
        shell(s, 2 * w, d)
        for y in (0, (d + 1.2) / 2):  # a wall between, with an opening
            s.box((w - 0.05, y, 0), (0.1, (d - 1.2) / 2, 2.6))
        for x in (0, w):
            s.place(half, pose_on_floor(x, 0, 0))
            s.place(table, pose_on_floor(x + w / 2, 0.7 * d, angle))
        w *= 2
    else:
        w, d = rng.uniform(3.5, 7), rng.uniform(5, 8)
        d = w + 1 if kind == "quarter turn" else d
        w = d if kind == "quarter turn" else w
        shell(s, w, d)
        furnish(s, kind, rng, w, d)
    for _ in range(small_things):
        place = float(rng.uniform(0.4, w - 0.4)), float(rng.uniform(0.4, d - 0.4)), float(rng.uniform(0, 360))
        s.place(clutter.thing(rng, 0.5), pose_on_floor(*place, float(rng.choice([0, 0, 0.75]))))
    return Scene("primitives", kind, s, [(0, 0, float(w), float(d))])


def furnish(s: Solids, kind: str, rng: np.random.Generator, w: float, d: float) -> None:
    """What repeats within one room."""
    seed = int(rng.integers(1 << 30))
    if kind == "half turn":
        half = along_walls(rng, w, d)
        s.place(half, np.eye(4))
        s.place(half, turn(180, (w / 2, d / 2, 0)))
    elif kind == "quarter turn":
        table, angle = table_with_chairs(rng), float(rng.choice([0, 20, 45, 90]))
        for k in range(4):
            s.place(table, turn(90 * k, (w / 2, d / 2, 0)) @ pose_on_floor(w / 4, d / 4, angle))
    elif kind == "desks":
        angle, columns, rows = float(rng.choice([0, 90])), max(int(w // 2), 1), int(d // 2)
        for i, j in np.ndindex(columns, rows):
            same = np.random.default_rng(seed)
            desk, chair = seats.desk(same), seats.office_chair(same)
            T = pose_on_floor(w * (i + 0.5) / columns, d * (j + 0.5) / rows, angle)
            s.place(desk.solids, T @ pose_on_floor(0, -desk.depth / 2, 0))
            s.place(chair.solids, T @ pose_on_floor(0, desk.depth / 2 + 0.1, 180))
    else:
        shelf = storage.bookshelf(np.random.default_rng(seed))
        for y in np.arange(1.2, d - 0.6, 1.8).tolist():
            for x in np.arange(0.5 + shelf.width / 2, w - 0.5 - shelf.width / 2, shelf.width + 0.02).tolist():
                s.place(shelf.solids, pose_on_floor(x, y, 0))


def shell(s: Solids, w: float, d: float) -> None:
    """Floor, ceiling and walls."""
    for z in (-0.1, 2.6):
        s.box((0, 0, z), (w, d, 0.1))
    for y in (-0.1, d):
        s.box((0, y, 0), (w, 0.1, 2.6))
    for x in (-0.1, w):
        s.box((x, 0, 0), (0.1, d, 2.6))


def along_walls(rng: np.random.Generator, w: float, d: float) -> Solids:
    """Furniture along the wall at y = 0 and in the near half of the walls beside it."""
    s, x = Solids(), 0.3
    while x < w - 1:
        piece = ALONG_WALLS[int(rng.integers(len(ALONG_WALLS)))](rng)
        if x + piece.width > w - 0.2:
            break
        s.place(piece.solids, pose_on_floor(x + piece.width / 2, 0.02, 0))
        x += piece.width + float(rng.uniform(0.1, 0.9))
    for side, angle in ((0.02, -90.0), (w - 0.02, 90.0)):
        piece = ALONG_WALLS[int(rng.integers(len(ALONG_WALLS)))](rng)
        y = float(rng.uniform(1.2, max(d / 2 - piece.width / 2, 1.25)))
        if y + piece.width / 2 < d / 2:
            s.place(piece.solids, pose_on_floor(side, y, angle))
    return s


def table_with_chairs(rng: np.random.Generator) -> Solids:
    """A table, its middle at the origin, and two equal chairs that face each other across it."""
    s, table = Solids(), seats.table(rng)
    s.place(table.solids, pose_on_floor(0, -table.depth / 2, 0))
    chair = seats.chair(rng)
    for angle in (0, 180):
        s.place(chair.solids, turn(angle, (0, 0, 0)) @ pose_on_floor(0, -table.depth / 2 - 0.25, 0))
    return s


if __name__ == "__main__":
    main()
