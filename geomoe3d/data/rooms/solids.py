"""Triangles put together from simple solids; what every generated room is made of.

Metres, z up. Unit shapes come from trimesh once and are scaled, turned and moved as arrays, so that a room
of a thousand boxes takes milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.types import FloatArray, IntArray

Triple = tuple[float, float, float]

GREY: Triple = (0.7, 0.7, 0.7)


@dataclass
class Solids:
    """Triangles with one colour per object."""

    vertices: list[FloatArray] = field(default_factory=list)
    faces: list[IntArray] = field(default_factory=list)
    colors: list[FloatArray] = field(default_factory=list)
    num_vertices: int = 0

    def scene(self) -> Any:
        """Open3D's ray casting scene of all triangles, on one thread."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        tensor = o3d.core.Tensor.from_numpy
        scene.add_triangles(
            tensor(np.concatenate(self.vertices).astype(np.float32)),
            tensor(np.concatenate(self.faces).astype(np.uint32)),
        )
        return scene

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner."""
        low = np.min([v.min(axis=0) for v in self.vertices], axis=0)
        return low, np.max([v.max(axis=0) for v in self.vertices], axis=0)

    def triangles(self, vertices: FloatArray, faces: IntArray, color: Triple = GREY) -> None:
        """Add triangles as they are."""
        self.vertices.append(vertices)
        self.faces.append(faces + self.num_vertices)
        self.colors.append(np.tile(color, (len(faces), 1)))
        self.num_vertices += len(vertices)

    def add(self, mesh: Any, color: Triple = GREY) -> None:
        """Add a trimesh object in the coordinates it has."""
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        self.triangles(vertices, np.asarray(mesh.faces, dtype=np.int64), color)

    def place(self, other: Solids, T: FloatArray) -> None:
        """Add a copy of other solids, moved by T (4, 4)."""
        for vertices, faces, colors in zip(other.vertices, other.faces, other.colors, strict=True):
            self.vertices.append(transform_points(T, vertices))
            self.faces.append(faces + self.num_vertices)
            self.colors.append(colors)
        self.num_vertices += other.num_vertices

    def box(
        self,
        corner: Triple,
        size: Triple,
        color: Triple = GREY,
        turn_deg: float = 0.0,
        about: tuple[float, float] | None = None,
    ) -> None:
        """A box from its lowest corner and edges, turned about the vertical through ``about``."""
        unit, faces = _unit("box")
        vertices = unit * size + (np.asarray(corner) + np.asarray(size) / 2)
        if turn_deg:
            x, y = about if about is not None else (corner[0] + size[0] / 2, corner[1] + size[1] / 2)
            vertices = transform_points(turn(turn_deg, (x, y, 0.0)), vertices)
        self.triangles(vertices, faces, color)

    def cylinder(
        self,
        foot: Triple,
        radius: float,
        height: float,
        color: Triple = GREY,
        top_radius: float | None = None,
    ) -> None:
        """An upright cylinder on its foot, or a blunt cone where ``top_radius`` differs."""
        unit, faces = _unit("cylinder")
        vertices = unit * (radius, radius, height) + (0.0, 0.0, height / 2)
        if top_radius is not None:
            vertices[unit[:, 2] > 0, :2] *= top_radius / radius
        self.triangles(vertices + np.asarray(foot), faces, color)

    def rod(self, start: Triple, end: Triple, radius: float, color: Triple = GREY) -> None:
        """A cylinder between two points."""
        unit, faces = _unit("rod")
        axis = np.asarray(end) - np.asarray(start)
        length = float(np.linalg.norm(axis))
        if length == 0:
            return
        z = axis / length
        R = frame_along(z)
        middle = (np.asarray(start) + np.asarray(end)) / 2
        self.triangles((unit * (radius, radius, length)) @ R.T + middle, faces, color)

    def blob(
        self,
        center: Triple,
        radii: Triple,
        rng: np.random.Generator,
        roughness: float = 0.0,
        color: Triple = GREY,
    ) -> None:
        """An ellipsoid, dented by a few random waves: cushions, bags, leaves, clothes."""
        unit, faces = _unit("ball")
        scale = np.ones(len(unit))
        if roughness:
            for _ in range(6):
                direction, phase = rng.normal(0, 3.0, 3), rng.uniform(0, 2 * np.pi)
                scale += roughness / 2 * np.sin(unit @ direction + phase)
        self.triangles(unit * scale[:, None] * radii + np.asarray(center), faces, color)

    def sheet(
        self, heights: FloatArray, corner: Triple, size: tuple[float, float], color: Triple = GREY
    ) -> None:
        """A height field over a rectangle: rugs, blankets, rough ground.

        Args:
            heights: (rows, columns) metres above ``corner``, rows along y.
            corner: lowest corner of the rectangle.
            size: extents along x and y.
            color: of all triangles.
        """
        vertices, faces = grid_triangles(heights.shape)
        rows, columns = heights.shape
        scaled = vertices * (size[0] / (columns - 1), size[1] / (rows - 1), 0.0)
        scaled[:, 2] = heights.ravel()
        self.triangles(scaled + np.asarray(corner), faces, color)


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number drawn evenly between two."""
    return float(rng.uniform(low, high))


def frame_along(z: FloatArray) -> FloatArray:
    """(3, 3) rotation that turns the vertical into the unit vector z (3,)."""
    x = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def grid_triangles(shape: tuple[int, ...]) -> tuple[FloatArray, IntArray]:
    """Vertices (rows*columns, 3), x along columns and y along rows by whole numbers, and triangles."""
    rows, columns = shape
    y, x = np.mgrid[:rows, :columns]
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(rows * columns)], axis=1).astype(np.float64)
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    lower, upper = np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)
    return vertices, np.concatenate([lower, upper]).astype(np.int64)


def turn(angle_deg: float, about: Triple) -> FloatArray:
    """The (4, 4) turn about the vertical line through a point."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    center = np.asarray(about)
    return make_transform(R, center - R @ center)


def pose_on_floor(x: float, y: float, angle_deg: float, z: float = 0.0) -> FloatArray:
    """The (4, 4) that turns about the vertical and then moves to a place."""
    T = turn(angle_deg, (0.0, 0.0, 0.0))
    T[:3, 3] = (x, y, z)
    return T


@lru_cache(maxsize=8)
def _unit(shape: str) -> tuple[FloatArray, IntArray]:
    import trimesh

    mesh: Any = {
        "box": lambda: trimesh.creation.box(extents=(1, 1, 1)),
        "cylinder": lambda: trimesh.creation.cylinder(radius=1, height=1, sections=24),
        "rod": lambda: trimesh.creation.cylinder(radius=1, height=1, sections=10),
        "ball": lambda: trimesh.creation.icosphere(subdivisions=3, radius=1),
    }[shape]()
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
