"""A whole scene to walk through: a generated room or flat, or a mesh of a real or modelled place.

Which of them a scene number gives follows from the seed alone. Building one takes 0.1 to 0.5 s.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.data.rooms.arrange import furnish
from geomoe3d.data.rooms.models import ModelLibrary
from geomoe3d.data.rooms.shell import Rect, build_shell, plan_flat
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.errors import FormatError, InputError


@dataclass
class Scene:
    """Triangles and where a camera may be.

    Attributes:
        kind: primitives, models or mesh.
        name: kinds of rooms, or the mesh's file name.
        solids: triangles in metres, z up.
        areas: rectangles of floor in which a camera may walk.
        floor: height of the floor where it is level, or None where rays must find it.
    """

    kind: str
    name: str
    solids: Solids
    areas: list[Rect]
    floor: float | None = 0.0
    rays: Any = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.rays is None:
            self.rays = self.solids.scene()


def generate_scene(
    rng: np.random.Generator, library: ModelLibrary | None = None, density: tuple[float, float] = (5.0, 60.0)
) -> Scene:
    """A furnished room or flat.

    Args:
        rng: decides it.
        library: models to be mixed in, or None for primitives alone.
        density: range of small things per square metre of table or shelf, drawn log-uniformly.
    """
    num_rooms = int(rng.choice([1, 2, 3, 4], p=[0.5, 0.25, 0.15, 0.1]))
    solids = Solids()
    kinds, areas = [], []
    # Tidy rooms as often as full ones, so by ratio.
    per_area = float(np.exp(rng.uniform(*np.log(np.maximum(density, 1e-3)))))
    for room in plan_flat(rng, num_rooms):
        build_shell(rng, solids, room)
        kinds.append(furnish(rng, solids, room, library, per_area))
        areas.append(room.rect)
    return Scene("primitives" if library is None else "models", "+".join(kinds), solids, areas)


def load_mesh_scene(path: str | Path) -> Scene:
    """A mesh as it is, in metres with z up. Raises InputError: no such file, or it holds no triangles;
    FormatError: it cannot be read."""
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise InputError(f"scene mesh '{path}' does not exist")
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # loaders of five formats raise nearly anything
        raise FormatError(f"scene mesh '{path}' cannot be read: {error}") from None
    faces = np.asarray(getattr(mesh, "faces", np.zeros((0, 3))), dtype=np.int64)
    if not len(faces):
        raise InputError(f"scene mesh '{path}' holds no triangles")
    solids = Solids()
    solids.triangles(np.asarray(mesh.vertices, dtype=np.float64), faces)
    low, high = solids.bounds
    area = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return Scene("mesh", path.stem, solids, [area], floor=None)
