"""What keeps real things from being ideal solids: surfaces bend, bulge and hang.

Faces of generated solids are exact planes that meet at right angles, so that their descriptors repeat all
over a room; real cushions, clothes, cables, paper and worn boards do not. Each part of a scene is bent by a
smooth field fixed in the world, so all views agree on it. It is applied to the depth that rays found, along
the ray and to first order, which needs no finer triangles. About 12 ms per image of 320 x 240 on one
core.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator

from geomoe3d.config import Section
from geomoe3d.data.rooms.sensor import Hits
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.types import FloatArray


class ReliefSettings(Section):
    """How far surfaces are from planes.

    Attributes:
        bend: root mean square slope between a part's surfaces and their planes, median over parts.
        spread: standard deviation of its logarithm from part to part.
        structure: factor for walls, floors and ceilings.
        wavelength: range of the waves, metres, log-uniform.
        waves: their number.
    """

    bend: float = Field(0.215, ge=0)
    spread: float = Field(0.8, ge=0)
    structure: float = Field(0.25, ge=0)
    wavelength: tuple[float, float] = (0.25, 1.0)
    waves: int = Field(8, ge=1)

    @model_validator(mode="after")
    def _check(self) -> ReliefSettings:
        if not 0 < self.wavelength[0] <= self.wavelength[1]:
            raise ValueError("wavelength must be a range [low, high] with 0 < low <= high")
        return self


class Relief:
    """The field of one scene and how strongly each of its triangles follows it.

    Args:
        rng: decides the field and the strength of each part.
        solids: parts of the scene; a scene mesh is one part as large as a wall.
        settings: see `ReliefSettings`.
    """

    def __init__(self, rng: np.random.Generator, solids: Solids, settings: ReliefSettings) -> None:
        strengths = []
        for vertices, faces in zip(solids.vertices, solids.faces, strict=True):
            extent = np.sort(np.ptp(vertices, axis=0))
            # Parts that extend so far along two axes, in metres, are walls, floors and ceilings.
            factor = settings.structure if extent[1] > 1.8 else 1.0
            strengths.append(np.full(len(faces), factor * rng.lognormal(0.0, settings.spread)))
        self._strength = np.concatenate(strengths).astype(np.float32)
        count = settings.waves
        shortest, longest = np.log(settings.wavelength)
        length = np.exp(rng.uniform(shortest, longest, count))
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        self._waves = (2 * np.pi / length[:, None] * direction).astype(np.float32)
        self._phase = rng.uniform(0, 2 * np.pi, count).astype(np.float32)
        way = rng.normal(size=(count, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        # A wave of amplitude a and length L has the slope 2 pi a / L: long waves are high ones.
        # Of a wave's square a half is its mean, a third lies along the normal, two thirds rise in the plane.
        amplitude = settings.bend * length / (2 * np.pi) * np.sqrt(9.0 / count)
        self._way = (amplitude[:, None] * way).astype(np.float32)

    def bend(self, hits: Hits, rays: FloatArray, T_world_camera: FloatArray) -> Hits:
        """The same image with every depth moved to where the bent surface is.

        Args:
            hits: what straight surfaces gave.
            rays: (H*W, 3) directions with z = 1 in the camera's frame.
            T_world_camera: (4, 4).
        """
        met = np.flatnonzero(np.isfinite(hits.depth.ravel()))
        depth = hits.depth.ravel().copy()
        directions = (rays[met] @ T_world_camera[:3, :3].T).astype(np.float32)
        points = T_world_camera[:3, 3].astype(np.float32) + depth[met, None].astype(np.float32) * directions
        shift = np.sin(points @ self._waves.T + self._phase) @ self._way
        shift *= self._strength[hits.triangle[met]][:, None]
        normals = hits.normal[met]
        across = np.einsum("ij,ij->i", directions, normals)
        # To first order the shift along a grazing ray has no limit.
        least = 0.25 * np.linalg.norm(directions, axis=1)
        across = np.where(across < 0, np.minimum(across, -least), np.maximum(across, least))
        along = np.einsum("ij,ij->i", shift, normals) / across
        # Metres along a ray: more would no longer be the same surface from elsewhere.
        depth[met] += np.clip(along, -0.25, 0.25)
        return Hits(depth.reshape(hits.depth.shape), hits.slope, hits.triangle, hits.normal)
