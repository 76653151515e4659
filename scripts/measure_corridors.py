"""Places in which a scan slides along itself: how often is a wrong answer called ok?

    python scripts/measure_corridors.py OUT [--count 60] [--seed 0] [--set KEY=VALUE ...]

Corridors, street canyons, tunnels and fields are generated in turn, each scanned twice from places 2 to 8 m apart, the
second scan turned about the vertical by any angle, by a spinning sensor of 16 or 32 rings or by one that sees a dense
sphere; 2 cm of noise, a range gate. One in three has nothing in it that tells where along it one stands, the others
doors, pillars, parked cars or bushes. An answer is right within 5 degrees and 0.5 m. Truth scores, nothing else. Lines
go to OUT/corridors.jsonl as pairs are finished; called again, the command goes on.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from geomoe3d.config import load_config
from geomoe3d.geometry.se3 import inverse, make_transform, rotation_error_deg, translation_error
from geomoe3d.registration import Registrar
from geomoe3d.types import FloatArray

Mesh = Any  # Open3D's own types know too little of its meshes
MOST_DEGREES, MOST_METRES = 5.0, 0.5
HALF_LENGTH = 60.0
GATE = 30.0  # metres
NOISE = 0.02


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "corridors.jsonl"
    done = {r["number"]: r for r in map(json.loads, path.read_text().splitlines())} if path.exists() else {}
    registrar = Registrar(load_config(None, given.settings))
    with path.open("a") as file:
        for number in range(given.count):
            if number not in done:
                done[number] = measure(number, given.seed, registrar)
                file.write(json.dumps(done[number]) + "\n")
                file.flush()
    tell([done[number] for number in range(given.count)])


def measure(number: int, seed: int, registrar: Registrar) -> dict[str, object]:
    """One pair: made, registered, scored."""
    kind, sensor = list(PLACES)[number % 4], ("rings", "sphere")[number // 4 % 2]
    source, target, T = scans(number, seed)
    result = registrar.register(source, target)
    turn, shift = rotation_error_deg(result.T_target_source, T), translation_error(result.T_target_source, T)
    right = bool(np.isfinite(turn) and turn < MOST_DEGREES and shift < MOST_METRES)
    return {
        "number": number,
        "kind": kind,
        "sensor": sensor,
        "bare": number // 8 % 3 == 0,
        "right": right,
        "status": result.status,
        "confidence": result.confidence,
        "rotation_error_deg": float(turn),
        "translation_error": float(shift),
    }


def scans(number: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Source, target, each with its sensor at the origin, and the true transform."""
    rng = np.random.default_rng((seed, number))
    kind, rings = list(PLACES)[number % 4], number // 4 % 2 == 0
    height, mesh = PLACES[kind](rng, number // 8 % 3 == 0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    first = np.array([0.0, rng.uniform(-0.5, 0.5), height])
    second = first + np.array([rng.uniform(2, 8), rng.uniform(-0.4, 0.4), 0.0])
    angle = rng.uniform(-math.pi, math.pi)
    c, s = math.cos(angle), math.sin(angle)
    poses = [
        make_transform(np.eye(3), first),
        make_transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), second),
    ]
    clouds = [seen(scene, pose, directions(rings, 16 if number % 3 else 32), rng) for pose in poses]
    return clouds[0], clouds[1], inverse(poses[1]) @ poses[0]


def directions(rings: bool, count: int) -> FloatArray:
    """Unit rays (n, 3) in the sensor's frame."""
    if rings:
        low, high = (-15, 15) if count == 16 else (-25, 15)
        turn, rise = np.meshgrid(
            np.linspace(-math.pi, math.pi, 1800, endpoint=False), np.radians(np.linspace(low, high, count))
        )
    else:
        turn, rise = np.meshgrid(
            np.linspace(-math.pi, math.pi, 720, endpoint=False), np.radians(np.linspace(-60, 80, 280))
        )
    flat = np.cos(rise)
    rays: FloatArray = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sin(rise)], -1).reshape(-1, 3)
    return rays


def seen(
    scene: o3d.t.geometry.RaycastingScene, pose: FloatArray, rays: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Points (n, 3) in the sensor's frame, with noise along the ray, none beyond the gate."""
    asked = np.hstack([np.tile(pose[:3, 3], (len(rays), 1)), rays @ pose[:3, :3].T]).astype(np.float32)
    cast = scene.cast_rays(o3d.core.Tensor.from_numpy(asked))
    distance: FloatArray = cast["t_hit"].numpy().astype(np.float64)
    hit = distance < GATE
    points: FloatArray = rays[hit] * (distance[hit] + rng.normal(0, NOISE, hit.sum()))[:, None]
    return points


def box(low: Sequence[float], high: Sequence[float]) -> Mesh:
    """An axis-parallel box."""
    size = np.asarray(high, float) - np.asarray(low, float)
    return o3d.geometry.TriangleMesh.create_box(*size).translate(np.asarray(low, float))


def along(rng: np.random.Generator, count: Any) -> FloatArray:
    """Places along the axis, most of them near the scans."""
    places: FloatArray = rng.uniform(-20, 28, count)
    return places


def corridor(rng: np.random.Generator, bare: bool) -> tuple[float, Mesh]:
    """Indoors: walls 2 to 3 m apart; doors and pillars stand out of them."""
    half, top = rng.uniform(1, 1.5), rng.uniform(2.4, 3)
    mesh = box([-HALF_LENGTH, -half, -0.1], [HALF_LENGTH, half, 0])
    mesh += box([-HALF_LENGTH, -half, top], [HALF_LENGTH, half, top + 0.1])
    for side in (-1, 1):
        mesh += box(
            [-HALF_LENGTH, min(side * half, side * (half + 0.1)), 0],
            [HALF_LENGTH, max(side * half, side * (half + 0.1)), top],
        )
    for x in [] if bare else along(rng, rng.integers(6, 14)):
        side, depth, width = rng.choice([-1, 1]), rng.uniform(0.1, 0.4), rng.uniform(0.3, 1.2)
        inner, wall = side * (half - depth), side * half
        mesh += box([x, min(inner, wall), 0], [x + width, max(inner, wall), rng.uniform(1, top)])
    return 1.4, mesh


def canyon(rng: np.random.Generator, bare: bool) -> tuple[float, Mesh]:
    """A street between facades; balconies and parked cars."""
    half, top = rng.uniform(6, 10), rng.uniform(12, 20)
    mesh = box([-HALF_LENGTH, -half, -0.1], [HALF_LENGTH, half, 0])
    for side in (-1, 1):
        mesh += box(
            [-HALF_LENGTH, min(side * half, side * (half + 1)), 0],
            [HALF_LENGTH, max(side * half, side * (half + 1)), top],
        )
    for x in [] if bare else along(rng, rng.integers(8, 20)):
        side = rng.choice([-1, 1])
        if rng.random() < 0.5:
            y = side * (half - rng.uniform(0.3, 1))
            mesh += box([x, y - 0.9, 0.2], [x + 4.3, y + 0.9, 1.5])
        else:
            inner, wall, z = side * (half - rng.uniform(0.8, 1.5)), side * half, rng.uniform(3, 9)
            mesh += box([x, min(inner, wall), z], [x + rng.uniform(2, 4), max(inner, wall), z + 1.1])
    return 1.8, mesh


def tunnel(rng: np.random.Generator, bare: bool) -> tuple[float, Mesh]:
    """A tube with a road; niches and boxes at its wall."""
    radius = rng.uniform(2.5, 5)
    turn = np.linspace(0, 2 * math.pi, 73)
    x = np.arange(-HALF_LENGTH, HALF_LENGTH + 1.0, 2.0)
    rim = np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1)
    points = np.array([[a, y, z + 0.5 * radius] for a in x for y, z in rim])
    width = len(turn)
    faces = [
        face
        for i in range(len(x) - 1)
        for k in range(width - 1)
        for face in (
            [i * width + k, i * width + k + 1, (i + 1) * width + k],
            [i * width + k + 1, (i + 1) * width + k + 1, (i + 1) * width + k],
        )
    ]
    mesh: Mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points), o3d.utility.Vector3iVector(faces)
    )
    mesh += box([-HALF_LENGTH, -radius, -0.1], [HALF_LENGTH, radius, 0])
    for place in [] if bare else along(rng, rng.integers(6, 14)):
        side, reach = rng.choice([-1, 1]), radius * rng.uniform(0.55, 0.75)
        y = sorted((side * reach, side * radius))
        mesh += box([place, y[0], 0], [place + rng.uniform(0.5, 2), y[1], rng.uniform(0.8, 2)])
    return 1.6, mesh


def field(rng: np.random.Generator, bare: bool) -> tuple[float, Mesh]:
    """Open ground, slightly uneven; bushes."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-60, 60, 121), np.linspace(-60, 60, 121)))
    waves = rng.uniform(0.03, 0.1, (4, 2)), rng.uniform(0, 6, 4)
    z = sum(0.05 * np.sin(k[0] * x + k[1] * y + p) for k, p in zip(*waves, strict=True))
    index = np.arange(121 * 121).reshape(121, 121)
    quads = [index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]]
    a, b, c, d = (q.ravel() for q in quads)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    mesh: Mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(np.stack([x, y, z], 1)), o3d.utility.Vector3iVector(faces)
    )
    for _ in range(0 if bare else rng.integers(8, 20)):
        ball = o3d.geometry.TriangleMesh.create_sphere(rng.uniform(0.4, 1.5), 8)
        mesh += ball.translate([*rng.uniform(-20, 20, 2), rng.uniform(0, 0.5)])
    return 1.8, mesh


PLACES: dict[str, Callable[[np.random.Generator, bool], tuple[float, Mesh]]] = {
    "corridor": corridor,
    "canyon": canyon,
    "tunnel": tunnel,
    "field": field,
}


def tell(rows: list[dict[str, object]]) -> None:
    """The table."""
    print("| place | sensor | pairs | right | ok | wrong and ok |\n|---|---|---|---|---|---|")
    for kind in (*PLACES, "all"):
        for sensor in ("rings", "sphere"):
            some = [r for r in rows if kind in ("all", r["kind"]) and r["sensor"] == sensor]
            ok = [r for r in some if r["status"] == "ok"]
            right = sum(bool(r["right"]) for r in some)
            wrong = sum(not r["right"] for r in ok)
            print(f"| {kind} | {sensor} | {len(some)} | {right} | {len(ok)} | {wrong} |")
    for r in rows:
        if r["status"] == "ok" and not r["right"]:
            print(r)


if __name__ == "__main__":
    main()
