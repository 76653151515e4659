"""What a matcher is: from the features of two clouds to putative correspondences.

Place: match, between features and outlier rejection.
"""

from __future__ import annotations

from abc import abstractmethod

from geomoe3d.errors import InputError
from geomoe3d.parts import Part, Registry
from geomoe3d.types import Correspondences, Float32Array, PreparedCloud

BLOCK_ENTRIES = 1_000_000
"""Entries of the similarity matrix that are there at a time."""


class Matcher(Part):
    """Pairs points of two clouds whose features are alike; wrong pairs are expected."""

    @abstractmethod
    def __call__(
        self,
        source: PreparedCloud,
        target: PreparedCloud,
        *,
        limit: int,
        seed: int = 0,
        with_ratio: bool = False,
    ) -> Correspondences:
        """At most ``limit`` correspondences; `Correspondences.between` makes them from rows of points.

        Args:
            source, target: clouds with features, each in its local coordinates.
            limit: most correspondences.
            seed: decides every random choice.
            with_ratio: whether the attribute ``ratio`` is asked for.
        """


def features_of(source: PreparedCloud, target: PreparedCloud) -> tuple[Float32Array, Float32Array]:
    """The features of both clouds. Raises InputError: a cloud without features."""
    if source.features is None or target.features is None:
        raise InputError(
            "match needs clouds with features; call with_features(cloud, descriptor) on both first"
        )
    return source.features, target.features


matcher: Registry[Matcher] = Registry("matcher", "geomoe3d.matching", lambda: Matcher)
"""Decorator by which a matcher joins, and the choice by name."""
