"""Constants of matching and proposing."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from geomoe3d.config.section import Section, constant


class CorrespondencesExpert(Section):
    """Correspondences without clouds (`correspondence_registration.py`)."""

    most_looked_at: int = constant(6, "hypotheses", (1, 100), "that a network looks at")
    first_looked_at: int = constant(
        2, "hypotheses", (1, 100), "that it looks at before it is asked whether it has seen enough"
    )
    convinced: float = constant(
        3.0, "logit", (-100, 100), "verdict from which on no further hypotheses are looked at"
    )
    most_rows: int = constant(
        1000,
        "correspondences",
        (3, 1_000_000),
        "that a hypothesis is scored on; mutual ones first where there are more",
    )


class FeaturesExpert(Section):
    """Descriptors that join FPFH of several reaches (`features/`)."""

    fpfh_share: float = constant(
        0.3,
        "share",
        (0, 1),
        "of FPFH in the similarity of two learned features",
        "more hardly changes what is found",
    )
    num_nearest: int = constant(
        3, "points", (1, 100), "of a coarser grid whose features a point takes the mean of"
    )
    softening: float = constant(0.4, "voxels", (0.001, 100), "a point nearer than that hardly weighs more")


class KeypointsExpert(Section):
    """Correspondences taken for a surface (`clouds/keypoints.py`)."""

    pixel_deg: float = constant(
        5.0,
        "degrees",
        (0.1, 45),
        "pixels of what a sensor saw: keypoints are sparse, finer ones would stay empty",
    )
    normal_neighbors: int = constant(10, "keypoints", (3, 1000), "whose plane a keypoint lies in")


class SurroundingsExpert(Section):
    """What consensus asks of pairs and of the sensors (`estimators/surroundings.py`)."""

    plane_sigma: float = constant(
        0.3, "sine", (0.01, 10), "between a plane and the line to the other point, both scans' difference"
    )
    turn_sigma: float = constant(0.35, "cosine", (0.01, 10), "between two planes, both scans' difference")
    least_agreement: float = constant(0.1, "-", (0, 1), "of a pair: its normals may both be badly fitted")
    matched_floor: float = constant(0.3, "-", (0, 1), "weight of a match whose normals meet at a right angle")
    matched_slope: float = constant(
        0.7, "per cosine", (0, 10), "what the weight grows by up to equal normals"
    )
    matched_least: float = constant(0.05, "-", (0, 1), "least weight of a match, whatever its normals")
    most_asked: int = constant(
        350, "points", (10, 100_000), "of each scan that are sought in the other's free space"
    )
    near: float = constant(
        30.0,
        "inlier thresholds",
        (1, 10_000),
        "from the sensor beyond which depths are shortened: pixels widen with the range",
    )
    deepest: float = constant(
        8.0, "inlier thresholds", (0.1, 1000), "in front of what was seen from where on a point counts fully"
    )
    violation_weight: float = constant(
        32.0,
        "-",
        (0, 1000),
        "of free space in the score of a hypothesis",
        "chosen among 8 to 64 on generated pairs, which rank on with it, and on real ones",
    )
    least_plausibility: float = constant(
        0.02, "-", (0, 1), "a place that is wrongly taken for the sensor's must not decide everything"
    )


class KeypointAlignmentExpert(Section):
    """Transforms drawn closer by the keypoints (`estimators/keypoint_alignment.py`)."""

    units: float = constant(
        2.0,
        "per inlier threshold",
        (0.1, 100),
        "units of length of GICP: one is a voxel where the threshold is two",
    )
    reach: float = constant(
        1.5,
        "inlier thresholds",
        (0.1, 100),
        "of matched keypoints; wider slides along walls, narrower leaves transforms where they were",
    )
    most_steps: int = constant(4, "steps", (1, 1000), "of GICP: the first ones do it, more slide along walls")
    most_agreeing: float = constant(
        0.2, "share", (0, 1), "of the correspondences from which on their own fit stands"
    )
    kept_agreement: float = constant(
        0.5, "share", (0, 1), "of the correspondences that must still agree; else it has slid away"
    )


class RansacExpert(Section):
    """RANSAC (`estimators/ransac.py`)."""

    most_refits: int = constant(50, "fits", (0, 10_000), "of the best sample to those that agree with it")


class ConsensusExpert(Section):
    """Consensus, beside the settings of `estimators/consensus.py`."""

    score_sigma: float = constant(
        0.75,
        "inlier thresholds",
        (0.01, 100),
        "of the residuals that count in the score of a transform",
        "somewhat narrower than the threshold told right from wrong better than a count or a truncated square",
    )
    last_refits: int = constant(
        10, "fits", (0, 1000), "at most, of the transforms that are carried to the end"
    )
    least_spread: float = constant(
        0.05,
        "inlier thresholds",
        (0, 100),
        "across the line through the inliers; thinner ones, also of RANSAC, leave the turn about it to the noise",
    )
    less_effort: tuple[Annotated[int, Field(ge=1, le=100_000)], Annotated[int, Field(ge=1, le=100_000)]] = (
        constant(
            (500, 60), "seeds, transforms", None, "that propose and are refined where others draw them closer"
        )
    )
    least_effort: tuple[
        Annotated[int, Field(ge=1, le=100_000)],
        Annotated[int, Field(ge=1, le=100_000)],
        Annotated[int, Field(ge=1, le=100_000)],
    ] = constant(
        (150, 15, 3),
        "seeds, transforms",
        None,
        "the same, and those returned, where only whether there is one is asked",
    )
