"""What a descriptor is: numbers at each point of a cloud by which the same surface is found again elsewhere.

Place: features, between prepare and match.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import ClassVar

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.parts import Part, Registry
from geomoe3d.types import Float32Array, PreparedCloud


class Descriptor(Part):
    """Gives every point of a preprocessed cloud a feature; the same for a cloud that is turned or moved.

    Attributes:
        dimension: numbers in a feature.
        needs_normals: whether features depend on the normals, and so change where these are turned over.
    """

    dimension: int
    needs_normals: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, cloud: PreparedCloud) -> Float32Array:
        """Features (n, ``dimension``) float32 of length 1; zero where there is nothing to go by.

        Args:
            cloud: n points on a grid of edge ``cloud.voxel_size``, local coordinates, with unit normals turned to
                the sensor; ``cloud.viewpoint`` is None where that is neither known nor guessed.
        """

    def again(self, cloud: PreparedCloud, before: Descriptor) -> Float32Array:
        """The same of a cloud that holds the features of another descriptor, which may save work."""
        return self(cloud)

    def mirrored(self, features: Float32Array) -> Float32Array | None:
        """What the features (n, ``dimension``) of a cloud become where it is mirrored, its normals with it; None where
        that cannot be told from the features."""
        return None


descriptor: Registry[Descriptor] = Registry("descriptor", "geomoe3d.features", lambda: Descriptor)
"""Decorator by which a descriptor joins, and the choice by name."""


def with_features(
    cloud: PreparedCloud, describe: Descriptor, before: Descriptor | None = None
) -> PreparedCloud:
    """The cloud with the features of a descriptor.

    Args:
        cloud: preprocessed.
        describe: the descriptor.
        before: the one whose features the cloud holds, where they are known to be its; may save work.

    Raises:
        InputError: what the descriptor gives is not (n, dimension) finite numbers.
    """
    found = describe(cloud) if before is None else describe.again(cloud, before)
    features = np.ascontiguousarray(found, dtype=np.float32)
    if features.shape != (len(cloud), describe.dimension):
        raise InputError(
            f"the descriptor {type(describe).__name__} gives features of shape {features.shape} for {len(cloud)} "
            f"points, expected ({len(cloud)}, {describe.dimension})"
        )
    if not np.isfinite(features).all():
        raise InputError(f"the descriptor {type(describe).__name__} gives features that are NaN or infinite")
    return replace(cloud, features=features)


def with_normals_flipped(cloud: PreparedCloud, describe: Descriptor) -> PreparedCloud:
    """The cloud as if its sensor had stood on the other side of every surface: no sensor, features anew."""
    flipped = replace(cloud, normals=-cloud.normals, viewpoint=None)
    return with_features(flipped, describe) if describe.needs_normals else flipped


def mirrored(cloud: PreparedCloud, describe: Descriptor) -> PreparedCloud:
    """The cloud with x the other way round, and its sensor with it."""
    flip = np.array([-1.0, 1.0, 1.0])
    turned = replace(
        cloud,
        points=flip * cloud.points,
        normals=flip * cloud.normals,
        features=None if cloud.features is None else describe.mirrored(cloud.features),
        viewpoint=None if cloud.viewpoint is None else flip * cloud.viewpoint,
        origin=flip * cloud.origin,
    )
    return turned if turned.features is not None else with_features(turned, describe)
