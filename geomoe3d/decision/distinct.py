"""Which transforms of one pair are clearly different ones."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from geomoe3d.config import expert
from geomoe3d.types import BoolArray, FloatArray, Hypothesis, PreparedCloud


def distinct(
    ranked: Iterable[Hypothesis], source: PreparedCloud, max_shift: float, limit: int
) -> list[Hypothesis]:
    """The best hypotheses that are all different transforms, at most ``limit``; see `are_different`."""
    given, center = list(ranked), source.center
    transforms = np.array([h.T_target_source for h in given]).reshape(-1, 4, 4)
    left, chosen = np.ones(len(given), dtype=np.bool_), list[Hypothesis]()
    while left.any() and len(chosen) < limit:
        best = int(left.argmax())
        chosen.append(given[best])
        left[best] = False
        left &= _differing(transforms[best], transforms, center, max_shift)
    return chosen


def are_different(T_a: FloatArray, T_b: FloatArray, source: PreparedCloud, max_shift: float) -> bool:
    """Whether two transforms (4, 4) are clearly different.

    Args:
        T_a, T_b: target from source.
        source: its centroid is where shifts are measured.
        max_shift: transforms closer than this, cloud units, and closer than 15 degrees are the same.
    """
    return bool(_differing(T_a, T_b[None], source.center, max_shift)[0])


def _differing(T: FloatArray, others: FloatArray, center: FloatArray, max_shift: float) -> BoolArray:
    """(K,) `are_different` of one transform (4, 4) and others (K, 4, 4); shifts of a point (3,) of the source."""
    shifts = np.linalg.norm((others - T)[:, :3] @ np.append(center, 1.0), axis=1)
    traces = np.einsum("kij,ij->k", others[:, :3, :3], T[:3, :3])
    least = 1 + 2 * np.cos(np.radians(expert().selection.different_turn_deg))
    found: BoolArray = (shifts > max_shift) | (traces < least)
    return found
