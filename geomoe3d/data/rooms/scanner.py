"""A laser scanner in a scene of triangles: all around, in rings or in an even raster of angles; its places.

Two kinds stand for the field: a spinning sensor with some tens of rings, as on vehicles and robots, and a
scanner on a tripod that covers the whole sphere. What is modelled: the pattern of angles, noise of the
range, dropout on grazing surfaces, and the limits of range. Cost: 65 ms for 60,000 rays on one core.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from geomoe3d.config import Section
from geomoe3d.data.rooms.scenes import Scene
from geomoe3d.data.rooms.walk import floor_below, is_free
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.types import FloatArray


class ScannerSettings(Section):
    """One kind of scanner.

    Attributes:
        rings: number of elevations.
        elevation_deg: lowest and highest of them.
        azimuth_step_deg: angle between neighbouring rays of a ring.
        range_noise: standard deviation along the ray, metres.
        near: least range, metres.
        far: largest range, metres.
        min_slope: cosine between ray and normal below which a surface returns nothing.
    """

    rings: int = 32
    elevation_deg: tuple[float, float] = (-30.0, 15.0)
    azimuth_step_deg: float = 0.3
    range_noise: float = 0.015
    near: float = 0.5
    far: float = 60.0
    min_slope: float = 0.05


SPINNING = ScannerSettings()
"""32 rings of 1,200 rays."""
TRIPOD = ScannerSettings(
    rings=300, elevation_deg=(-60.0, 89.0), azimuth_step_deg=0.5, range_noise=0.003, near=0.4
)
"""The whole sphere but for the tripod's foot, twice a degree."""


@dataclass(frozen=True)
class LaserScanner:
    """Takes scans with one kind of scanner."""

    settings: ScannerSettings

    def scan(self, scene: Any, T_world_sensor: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Points (n, 3) in the sensor's frame (z up, the sensor at the origin), metres.

        Args:
            scene: ray casting scene (`Solids.scene`).
            T_world_sensor: (4, 4) pose of the sensor.
            rng: decides the noise.
        """
        import open3d as o3d

        s = self.settings
        directions = self._directions()
        turned = directions @ T_world_sensor[:3, :3].T
        bundle = np.column_stack([np.broadcast_to(T_world_sensor[:3, 3], turned.shape), turned])
        hits = scene.cast_rays(o3d.core.Tensor.from_numpy(bundle.astype(np.float32)), nthreads=1)
        reach = hits["t_hit"].numpy().astype(np.float64)
        slope = np.abs(np.einsum("ij,ij->i", turned, hits["primitive_normals"].numpy().astype(np.float64)))
        seen = np.isfinite(reach) & (reach > s.near) & (reach < s.far) & (slope > s.min_slope)
        noisy = reach[seen] + s.range_noise * rng.standard_normal(int(seen.sum()))
        points: FloatArray = directions[seen] * noisy[:, None]
        return points

    def _directions(self) -> FloatArray:
        s = self.settings
        elevation = np.radians(np.linspace(*s.elevation_deg, s.rings))
        azimuth = np.radians(np.arange(0.0, 360.0, s.azimuth_step_deg))
        e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
        return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)


def stand_scanner(rng: np.random.Generator, scene: Scene, count: int) -> list[FloatArray]:
    """Poses T_world_sensor (4, 4) of a scanner that stands nearly upright, turned anyhow.

    Each is 1 to 8 m from one before, 1.2 to 1.7 m above the floor, with nothing within 40 cm.
    Fewer than ``count`` where the scene has no more place.
    """
    from scipy.spatial.transform import Rotation

    eyes: list[FloatArray] = []
    for _ in range(200 * count):
        if len(eyes) == count:
            break
        x0, y0, x1, y1 = scene.areas[int(rng.integers(len(scene.areas)))]
        x, y, height = (float(v) for v in (*rng.uniform([x0, y0], [x1, y1]), rng.uniform(1.2, 1.7)))
        floor = floor_below(scene, x, y)
        if floor is None:
            continue
        eye = np.array([x, y, floor + height])
        near = eyes[int(rng.integers(len(eyes)))] if eyes else None
        if near is not None and not 1.0 < float(np.linalg.norm(eye - near)) < 8.0:
            continue
        if is_free(scene, eye, 0.4):  # metres around it
            eyes.append(eye)
    turns = [[rng.uniform(0, 360), *rng.normal(0, 3.0, 2)] for _ in eyes]  # degrees: hardly tilted
    return [
        make_transform(Rotation.from_euler("ZYX", turn, degrees=True).as_matrix(), eye)
        for turn, eye in zip(turns, eyes, strict=True)
    ]
