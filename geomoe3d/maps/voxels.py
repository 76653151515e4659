"""A cloud of any size as the sums of its voxels: read in pieces, added to, made coarser.

The bottom of a map. Each voxel holds the sum and number of its points and, where the sensors are known, the sum of
the directions to them, so pieces may come in any order and scans may be added later; its means are those of the
whole. 64 bytes per voxel; a million points take some 0.3 s.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.types import FloatArray, IntArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_BITS = 21  # of a key, for each axis
_HALF = 2 ** (_BITS - 1)


@dataclass(frozen=True, eq=False)
class VoxelSums:
    """See the module.

    Attributes:
        edge: of the grid, cloud units.
        origin: (3,) file coordinates of the local frame's zero.
        keys: (M,) of the occupied voxels, rising.
        sums: (M, 3) of the points, local coordinates.
        counts: (M,) points.
        towards: (M, 3) sums of the unit directions from the points to the sensors that saw them; zero where none
            is known.
        sensors: (S, 3) where they stood, local coordinates; those within a voxel of another are left out.
    """

    edge: float
    origin: FloatArray
    keys: IntArray
    sums: FloatArray
    counts: IntArray
    towards: FloatArray
    sensors: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def empty(cls, edge: float, origin: FloatArray) -> VoxelSums:
        """Nothing yet."""
        none = np.zeros(0, dtype=np.int64)
        return cls(
            float(edge), np.asarray(origin, dtype=np.float64), none, np.zeros((0, 3)), none, np.zeros((0, 3))
        )

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def points(self) -> FloatArray:
        """(M, 3) mean points, local coordinates."""
        means: FloatArray = self.sums / self.counts[:, None]
        return means

    @cached_property
    def tree(self) -> cKDTree:
        """Of the mean points, which are its ``data``; made quickly, half a second for four million."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)

    def added(self, points: FloatArray, sensor: FloatArray | None = None) -> VoxelSums:
        """With more points.

        Args:
            points: (N, 3) finite file coordinates.
            sensor: (3,) file coordinates of the sensor that saw them all, or None where it is not known.

        Raises:
            InputError: the map spans more than 2^21 voxels along an axis.
        """
        local = points - self.origin
        towards, sensors = np.zeros_like(local), self.sensors
        if sensor is not None:
            place = sensor - self.origin
            towards = place - local
            towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
            if not (np.linalg.norm(sensors - place, axis=1) < self.edge).any():
                sensors = np.concatenate([sensors, place[None]])
        ones = np.ones(len(local), dtype=np.int64)
        fresh = _summed(self._keys(local), local, ones, towards)
        return replace(self._of(*_joined(self._columns(), fresh)), sensors=sensors)

    def coarser(self, factor: int = 2) -> VoxelSums:
        """On a grid so many times as wide; the same as if it had been so wide from the start."""
        cells = _cells(self.keys)
        keys = _packed(np.floor_divide(cells, factor))
        return self._of(*_summed(keys, *self._columns()[1:]), edge=self.edge * factor)

    def within(self, centers: FloatArray, radius: float) -> VoxelSums:
        """Only what lies so near to one of some places (k, 3), local coordinates."""
        points, near = self.points, np.zeros(len(self), dtype=np.bool_)
        for center in centers:
            near |= ((points - center) ** 2).sum(axis=1) <= radius**2
        return self._of(self.keys[near], self.sums[near], self.counts[near], self.towards[near])

    def edge_for(self, count: int) -> float:
        """The edge of a grid on which about so many voxels are occupied; at least this one's."""
        keys, edge, finer = self.keys, self.edge, len(self.keys)
        while len(keys) > max(count, 1):
            finer, edge = len(keys), 2 * edge
            keys = np.sort(_packed(_cells(keys) // 2))  # of millions np.unique takes ten times as long
            keys = keys[np.diff(keys, prepend=keys[0] - 1) > 0]
        if edge == self.edge or finer == len(keys):
            return edge
        return edge / 2 * float(2.0 ** (np.log(finer / count) / np.log(finer / len(keys))))

    def _keys(self, local: FloatArray) -> IntArray:
        cells = np.floor(local / self.edge)
        if len(cells) and np.abs(cells).max() >= _HALF:
            reach = float(np.abs(local).max())
            raise InputError(
                f"voxel size {self.edge:.4g} is too small for a map that reaches {reach:.4g} from its middle: more "
                f"than {2 * _HALF} voxels along one axis; use at least {reach / _HALF:.3g} or remove stray points"
            )
        return _packed(cells.astype(np.int64))

    def _columns(self) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
        return self.keys, self.sums, self.counts, self.towards

    def _of(
        self,
        keys: IntArray,
        sums: FloatArray,
        counts: IntArray,
        towards: FloatArray,
        edge: float | None = None,
    ) -> VoxelSums:
        edge = self.edge if edge is None else edge
        return VoxelSums(edge, self.origin, keys, sums, counts, towards, self.sensors)


def _packed(cells: IntArray) -> IntArray:
    shifted = cells + _HALF
    keys: IntArray = (shifted[:, 0] << 2 * _BITS) | (shifted[:, 1] << _BITS) | shifted[:, 2]
    return keys


def _cells(keys: IntArray) -> IntArray:
    mask = 2**_BITS - 1
    mixed = [(keys >> 2 * _BITS) & mask, (keys >> _BITS) & mask, keys & mask]
    cells: IntArray = np.stack(mixed, axis=1) - _HALF
    return cells


Columns = tuple[IntArray, FloatArray, IntArray, FloatArray]


def _joined(old: Columns, new: Columns) -> Columns:
    """Both, one row per key; what is there already is not sorted again."""
    if not len(old[0]):
        return new
    place = np.searchsorted(old[0], new[0])
    known = old[0][np.minimum(place, len(old[0]) - 1)] == new[0]
    held, fresh = place[known], place[~known]

    def column(before: Any, added: Any) -> Any:
        summed = before.copy()
        summed[held] += added[known]
        return np.insert(summed, fresh, added[~known], axis=0) if len(fresh) else summed

    keys = np.insert(old[0], fresh, new[0][~known])
    return keys, column(old[1], new[1]), column(old[2], new[2]), column(old[3], new[3])


def _summed(keys: IntArray, sums: FloatArray, counts: IntArray, towards: FloatArray) -> Columns:
    """One row per key."""
    if not len(keys):
        return keys, sums, counts, towards
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    summed = (np.add.reduceat(column[order], starts, axis=0) for column in (sums, counts, towards))
    a, b, c = summed
    return keys[starts], a, b, c
