"""What an outlier filter is: correspondences in, one weight each out.

Place: outlier rejection, between match and propose. A filter drops nothing and proposes nothing.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from geomoe3d.parts import Part, Registry
from geomoe3d.types import Correspondences, FilterOutput


class OutlierFilter(Part):
    """Anything that weighs correspondences.

    Attributes:
        needs: attributes of `Correspondences` beside the points without which it cannot work.
        takes_weights: whether it is a trained network, made with ``filter.weights``.
    """

    needs: frozenset[str] = frozenset()
    takes_weights: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """Weigh correspondences.

        Args:
            correspondences: N rows in local coordinates; the per-row attributes may be None.
            voxel_size: the grid the points came from, cloud units: what the scale of noise is.
            seed: decides every random choice.

        Returns:
            One weight per correspondence; for N = 0 an empty array.
        """


outlier_filter: Registry[OutlierFilter] = Registry("filter", "geomoe3d.filters", lambda: OutlierFilter)
"""Decorator by which an outlier filter joins, and the choice by name."""


@outlier_filter("none")
class NoFilter(OutlierFilter):
    """All correspondences weigh the same."""

    @classmethod
    def from_config(cls, config: object) -> NoFilter:
        """There is nothing to configure."""
        return cls()

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """See `OutlierFilter`: all ones."""
        return FilterOutput(np.ones(len(correspondences)))
