"""The rules by which answers to a benchmark are counted; they are no settings: figures of others go by them too."""

from __future__ import annotations

from pydantic import Field

from geomoe3d.config import Section


class Rules(Section):
    """What is right, and how it is counted."""

    rotation_limit_deg: float = Field(
        15.0, gt=0, description="degrees; a right transform errs less (strict). PointDSC's code has 15"
    )
    rotation_limit_20_deg: float = Field(
        20.0, gt=0, description="degrees; the limit that the GeoMoE paper names"
    )
    translation_limit: float = Field(0.30, gt=0, description="metres; a right transform errs less (strict)")
    rmse_limit: float = Field(
        0.20,
        gt=0,
        description="metres; the benchmark's RMSE of a right transform is at most this, as published",
    )
    num_unrelated: int = Field(
        200, ge=0, description="pairs of scans that share nothing, drawn from all scenes"
    )
    resamples: int = Field(2000, ge=1, description="of a bootstrap interval")
    num_bins: int = Field(10, ge=1, description="of the confidence, for the calibration error")
    least_matched: int = Field(
        10, ge=1, description="points in contact below which a local method has found nothing"
    )


RULES = Rules()
