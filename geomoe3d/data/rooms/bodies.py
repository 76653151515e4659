"""Single bodies, as people scan them one by one: furniture, piles of it, and grown shapes with limbs.

A grown shape is a trunk to which further blobs, rods, boxes and cones are joined, each to one before it,
in any direction: few symmetries, curved and flat parts, thin limbs. Bodies are brought to a size at which
a voxel of 5 cm is to them what the chosen voxel is to a scanned body: the network knows lengths in voxels
only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomoe3d.data.rooms.arrange import MAKERS
from geomoe3d.data.rooms.clutter import thing
from geomoe3d.data.rooms.models import ModelLibrary
from geomoe3d.data.rooms.solids import Solids, between, frame_along
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.types import FloatArray

_KINDS = ("piece", "pile", "grown")


def generate_body(rng: np.random.Generator, library: ModelLibrary | None) -> tuple[str, Solids]:
    """Its kind, and its triangles, centred at the origin, 1.8 to 5 m from corner to corner.

    Args:
        rng: decides it.
        library: models to be taken for furniture, or None for solids alone.
    """
    # Kinds by how often they are drawn.
    kind = str(rng.choice(_KINDS, p=(0.15, 0.3, 0.55)))
    while True:
        solids = {"piece": _piece, "pile": _pile}.get(kind, lambda rng, _: _grown(rng))(rng, library)
        if not looks_the_same_turned(solids):
            break
    low, high = solids.bounds
    size = float(np.exp(rng.uniform(*np.log((1.8, 5.0))))) / float(np.linalg.norm(high - low))
    # A new object: pieces of a library are shared.
    return kind, replace(solids, vertices=[(v - (low + high) / 2) * size for v in solids.vertices])


def looks_the_same_turned(solids: Solids) -> bool:
    """Whether a turn about an axis of the bounding box's centre leaves nearly all of the surface where it is.

    What is true of two scans of such a body cannot be told from the scans: a lamp, a table, a board. Turns by
    half about all three axes are tried, and by a third and a quarter about the vertical.
    """
    import open3d as o3d
    import trimesh
    from scipy.spatial.transform import Rotation

    low, high = solids.bounds
    center = (low + high) / 2
    mesh = trimesh.Trimesh(np.concatenate(solids.vertices), np.concatenate(solids.faces), process=False)
    points = np.asarray(trimesh.sample.sample_surface(mesh, 400, seed=0)[0]) - center
    rays = solids.scene()
    # Axis and degrees.
    for axis, degrees in ((0, 180), (1, 180), (2, 180), (2, 120), (2, 90)):
        turned = Rotation.from_euler("xyz"[axis], degrees, degrees=True).apply(points) + center
        away = rays.compute_distance(
            o3d.core.Tensor.from_numpy(turned.astype(np.float32)), nthreads=1
        ).numpy()
        # A turn of symmetry: nine in ten points come to lie within 3 % of the diagonal.
        if np.mean(away < 0.03 * np.linalg.norm(high - low)) > 0.9:
            return True
    return False


def any_attitude(rng: np.random.Generator) -> FloatArray:
    """(3, 3) uniform over SO(3)."""
    from scipy.spatial.transform import Rotation

    R: FloatArray = Rotation.random(random_state=rng).as_matrix()
    return R


def _piece(rng: np.random.Generator, library: ModelLibrary | None) -> Solids:
    if library is not None and rng.random() < 0.7:
        kinds = sorted(library.models)
        found = library.draw(kinds[int(rng.integers(len(kinds)))], rng)
        if found is not None:
            return found.solids
    makers = sorted(MAKERS)
    return MAKERS[makers[int(rng.integers(len(makers)))]](rng).solids


def _pile(rng: np.random.Generator, library: ModelLibrary | None) -> Solids:
    solids = Solids()
    for k in range(int(rng.integers(2, 6))):
        part = thing(rng, 0.5) if k and rng.random() < 0.5 else _piece(rng, library)
        low, high = part.bounds
        reach = 0.4 * float(np.linalg.norm(high - low))
        solids.place(part, make_transform(any_attitude(rng), rng.normal(0, reach, 3)))
    return solids


def _grown(rng: np.random.Generator) -> Solids:
    solids = Solids()
    joints: list[tuple[FloatArray, float]] = [(np.zeros(3), 0.5)]
    solids.blob((0, 0, 0), _triple(rng.uniform(0.25, 0.6, 3)), rng, between(rng, 0, 0.5))
    for _ in range(int(rng.integers(4, 14))):
        at, size = joints[int(rng.integers(len(joints)))]
        direction = rng.normal(0, 1, 3)
        direction /= np.linalg.norm(direction)
        start = at + 0.7 * size * direction
        size = max(size * between(rng, 0.4, 0.9), 0.08)
        part, end = _limb(rng, size)
        solids.place(part, make_transform(frame_along(direction), start))
        joints.append((start + end * direction, size))
    return solids


def _limb(rng: np.random.Generator, size: float) -> tuple[Solids, float]:
    """A part that begins at the origin and goes up, and where the next one may join it."""
    part, length = Solids(), size * between(rng, 0.8, 3.0)
    kind = rng.random()
    if kind < 0.45:
        radii = (*(size * rng.uniform(0.3, 0.9, 2)), length / 2)
        part.blob((0, 0, length / 2), _triple(np.array(radii)), rng, between(rng, 0, 0.5))
    elif kind < 0.7:
        radius = size * between(rng, 0.1, 0.5)
        part.cylinder((0, 0, 0), radius, length, top_radius=radius * between(rng, 0.1, 1.3))
    elif kind < 0.85:
        width, depth = (size * float(share) for share in rng.uniform(0.2, 1.4, 2))
        part.box((-width / 2, -depth / 2, 0), (width, depth, length))
    else:  # a bent rod
        bend = _triple(np.array([*rng.normal(0, 0.3 * length, 2), length / 2]))
        radius = size * between(rng, 0.1, 0.3)
        part.rod((0, 0, 0), bend, radius)
        part.rod(bend, (0, 0, length), radius)
    return part, length


def _triple(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
