"""What a refiner is: one transform polished.

Place: refine, between score and decide.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

from geomoe3d.clouds.pair import Pair
from geomoe3d.parts import Part, Registry
from geomoe3d.types import FloatArray, Hypothesis

PairRefiner = Callable[[Hypothesis], "tuple[FloatArray | None, str | None]"]
"""A hypothesis to its transform (4, 4) refined and None; or to its own, unchanged, and a sentence that says why;
or to None where nothing is left of it. Several may be refined at a time, by threads."""


class Refiner(Part):
    """Polishes transforms.

    Attributes:
        needs_clouds: whether it works on the clouds; bare correspondences are then left as they are.
    """

    needs_clouds: ClassVar[bool] = True

    @abstractmethod
    def about(self, pair: Pair) -> PairRefiner:
        """The refiner of one pair's hypotheses; made once per pair."""


refiner: Registry[Refiner] = Registry("refiner", "geomoe3d.refinement", lambda: Refiner)
"""Decorator by which a refiner joins, and the choice by name."""


@refiner("none")
class NoRefiner(Refiner):
    """Leaves every transform as it is."""

    @classmethod
    def from_config(cls, config: object) -> NoRefiner:
        """There is nothing to configure."""
        return cls()

    def about(self, pair: Pair) -> PairRefiner:
        """See `Refiner`."""
        return lambda hypothesis: (hypothesis.T_target_source, None)
