"""What decides an answer about two images: constants of the method with unit and range, as `expert` is for clouds."""

from __future__ import annotations

from pydantic import Field

from geomoe3d.config import Section


class KeypointRules(Section):
    """Keypoints and their matches."""

    number: int = Field(2000, ge=8, description="most keypoints of an image, the strongest")
    longer_side: int = Field(800, ge=16, description="pixels; larger images are reduced to that first")
    contrast: float = Field(1e-5, gt=0, description="so low that dull images give as many keypoints")
    ratio: float = Field(0.8, gt=0, le=1, description="ratio test by itself")
    loose_ratio: float = Field(0.95, gt=0, le=1, description="behind a network that rejects wrong matches")
    least_to_train: int = Field(16, ge=8, description="matches; pairs with fewer are not trained on")


class PoseRules(Section):
    """The relative pose, and when it is ok."""

    pixel_share: float = Field(1 / 800, gt=0, description="inlier threshold, a share of the longer side")
    most_samples: int = Field(2000, ge=1, description="of the robust estimator")
    sureness: float = Field(0.99999, gt=0, lt=1, description="it stops when this sure of a clean sample")
    least_inliers: int = Field(30, ge=5, description="with fewer a wrong pose finds as many")
    over_chance: float = Field(3.0, ge=1, description="inliers beyond these, over those of chance")
    least_agreeing: float = Field(0.25, ge=0, le=1, description="of kept matches, where none is rejected")
    least_parallax: float = Field(3.0, gt=0, description="inlier thresholds; with less it only turned")
    most_between_halves_deg: float = Field(10.0, gt=0, description="between poses of halves of the matches")
    other_pose_deg: float = Field(3.0, gt=0, description="a pose so far off is another one")
    explained: float = Field(0.9, gt=0, le=1, description="share of the inliers that makes it as good")


class HomographyRules(Section):
    """The homography, and when it is ok."""

    threshold: float = Field(3.0, gt=0, description="pixels: inlier threshold unless one is given")
    least_inliers: int = Field(15, ge=4, description="with fewer a wrong homography finds as many")
    most_between_halves: float = Field(3.0, gt=0, description="inlier thresholds between what halves give")
    most_deviation: float = Field(3.0, gt=0, description="inlier thresholds: deviation of a corner")


class MeasureRules(Section):
    """When cameras that come with photographs are believed, and what areas under the curve go up to."""

    least_share: float = Field(
        0.6, gt=0, le=1, description="of distinct matches within 2 pixels of their lines"
    )
    most_median: float = Field(1.0, gt=0, description="pixels: median distance from them, images reduced")
    pose: tuple[float, ...] = Field((5.0, 10.0, 20.0), description="degrees, as SuperGlue has them")
    corner: tuple[float, ...] = Field((3.0, 5.0, 10.0), description="pixels, as LoFTR has them")


KEYPOINTS, POSE, HOMOGRAPHY, MEASURE = KeypointRules(), PoseRules(), HomographyRules(), MeasureRules()
