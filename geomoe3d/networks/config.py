"""Numbers of the architecture that no setting varies: weights hold with them alone."""

from __future__ import annotations

from pydantic import Field

from geomoe3d.config import Section


class Fixed(Section):
    """What every network of a kind shares."""

    batch_norm_eps: float = Field(1e-5, gt=0, description="added to a variance before its root is taken")
    context_norm_eps: float = Field(1e-3, gt=0, description="the same of the norm over correspondences")
    verdict_width: int = Field(64, ge=1, description="hidden channels of the verdict")
    least_mean: float = Field(
        0.005,
        gt=0,
        description="added to a channel's mean, a share of the rows, before its logarithm is taken",
    )
    min_correspondences: int = Field(3, ge=3, description="with fewer no network is asked")
    threshold_voxels: float = Field(2.0, gt=0, description="voxels: inliers of the hypothesis behind a frame")


FIXED = Fixed()
