"""The configuration of a registration: one section for each part of the line, and one for experts.

Lengths are given in multiples of the voxel size, so that one configuration serves 5 cm rooms and 30 cm
lidar; only ``voxel_size`` itself is in cloud units.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator

from geomoe3d.config.expert import ExpertConfig
from geomoe3d.config.section import Section


class PartConfig(Section):
    """What every section of a part holds: which part, and the settings of a user's own."""

    name: str
    options: dict[str, Any] = Field(
        default_factory=dict, description="settings of a part of your own: keyword arguments of its class"
    )


class PreparationConfig(Section):
    """From a raw cloud to voxel points with oriented normals."""

    voxel_points: int = Field(3500, ge=200, description="points per cloud that an automatic voxel aims at")
    max_points: int = Field(
        30_000, ge=100, description="most voxel points per cloud; a finer voxel size is raised and said"
    )
    grid_shift: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="by how much the grid lies off its usual place along each axis, in voxels",
    )
    normal_radius: float = Field(2.0, gt=0, description="neighbourhood of a normal, in voxels")
    normal_neighbors: int = Field(30, ge=3, description="at most so many points fit a normal")
    viewpoint: Literal["auto", "origin", "guess", "centroid"] = Field(
        "auto",
        description="where the sensor stood, to which normals turn: the file's origin, a guess from what can "
        "be seen, the centroid, or auto: the origin if near both clouds, else where the files say, else a guess",
    )


class DescriptorConfig(PartConfig):
    """What describes the surface around each point in numbers that can be compared."""

    name: str = Field(
        "fpfh",
        description="fpfh; multiscale (fpfh of three reaches); learned (a small network on these; more true matches, "
        "slower, and asked in the second look anyway); or a class of your own: file.py:Class or module:Class",
    )
    radius: float = Field(5.0, gt=0, description="neighbourhood of a feature, in voxels")
    neighbors: int = Field(100, ge=3, description="at most so many points make a feature")


class MatchingConfig(PartConfig):
    """From features to putative correspondences."""

    name: str = Field(
        "one_way",
        description="one_way keeps each source point's nearest target, mutual only where that is mutual, ratio "
        "only where the second best is clearly worse, dual_softmax the pairs that prefer each other most; or a "
        "class of your own",
    )
    neighbors: int = Field(1, ge=1, le=10, description="targets kept per source point")
    max_ratio: float = Field(0.95, gt=0, le=1, description="largest distance ratio kept by ratio")
    max_correspondences: int = Field(
        1000, ge=3, description="at most so many are used: mutual ones first, then a seeded choice"
    )


class FilterConfig(PartConfig):
    """Outlier rejection: what weighs the correspondences before transforms are proposed."""

    name: str = Field(
        "none",
        description="none, spectral (needs no training), geomoe (a network that weighs correspondences, given "
        "its weights), or a class of your own",
    )
    weights: str | None = Field(None, description="trained weights of the filter: a .safetensors file")


class EstimatorConfig(PartConfig):
    """From weighted correspondences to candidate transforms."""

    name: str = Field(
        "consensus",
        description="consensus: sets that preserve lengths and planes; ransac: random samples; svd: one "
        "least squares fit, for correspondences that are nearly all right; or a class of your own",
    )
    inlier_threshold: float = Field(2.0, gt=0, description="largest residual of an inlier, in voxels")
    num_hypotheses: int = Field(20, ge=1, description="distinct hypotheses that consensus keeps by round")
    num_aligned: int = Field(
        6,
        ge=0,
        description="so many of them, best first, are drawn closer by the keypoints of both scans (where a "
        "network scores, of those it looks at); correspondences without clouds only, since clouds do it better",
    )
    one_way_weight: float = Field(
        0.5, ge=0, le=1, description="weight of a match that is not mutual beside 1 for one that is"
    )
    mutual_round: bool = Field(False, description="a second round proposes from the mutual matches alone")
    ransac_iterations: int = Field(50_000, ge=1, description="most samples drawn by ransac")
    ransac_confidence: float = Field(
        0.999, gt=0, lt=1, description="ransac stops when this sure that it has drawn a clean sample"
    )


class ScoringConfig(Section):
    """Who scores the hypotheses; the product of what they say decides."""

    scorers: tuple[str, ...] | Literal["auto"] = Field(
        "auto",
        description="surfaces: how well the clouds lie on each other; network: what a trained network says of "
        "the best few; classes of your own. auto: surfaces, and the network that ships. []: none, "
        "the estimator's first hypothesis is the answer",
    )
    weights: str | None = Field(
        None, description="trained weights of network: a .safetensors file or a shipped name"
    )
    options: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="settings of scorers of your own, by their names"
    )


class SecondLookConfig(Section):
    """More work on a pair whose first answer is doubtful."""

    descriptor: str = Field(
        "learned",
        description="features of an answer's clouds are computed once more where it is not ok: its matches join the "
        "others, its features score; a name as descriptor.name, with its defaults. none, or the same as that: no",
    )
    min_confidence: float = Field(
        0.97,
        ge=0,
        le=1,
        description="an answer found with that descriptor, checked by these scorers or sought twice is ok from this "
        "confidence on; decision.min_confidence counts where it is higher",
    )
    checked_below: float = Field(
        0.985,
        ge=0,
        le=1,
        description="an ok answer of less confidence that has a rival, or that few matches agree with, is shown to the "
        "surface network too; 0, or without it or the descriptor learned in the second look: none is",
    )
    num_checked: int = Field(
        3,
        ge=0,
        le=64,
        description="so many clearly different hypotheses are refined and shown to them beside it",
    )
    scorers: tuple[str, ...] = Field(
        ("surface_network",),
        description="who helps to choose among the refined hypotheses of clouds that were described again: "
        "surface_network, a network that looks at the points of both clouds with the features of learned; classes of "
        "your own",
    )
    grids: tuple[float, ...] = Field(
        (1.5, 2.0),
        description="coarser grids, in voxels, on which further hypotheses are sought when the first answer "
        "is doubtful; none: the first answer stands",
    )
    max_correspondences: int = Field(
        3500,
        ge=0,
        description="so many matches of the grid itself are asked for further hypotheses, where there are "
        "more than the first answer had; 0: none",
    )
    below: float = Field(
        0.8, ge=0, le=1, description="an answer that is not ok is doubtful below this confidence"
    )
    num_refined: int = Field(
        16, ge=1, description="so many of the best distinct hypotheses are polished before the choice"
    )
    num_judged: int = Field(
        16,
        ge=1,
        description="so many of the best distinct hypotheses are shown to the network, if there is one",
    )

    flip: bool = Field(
        True,
        description="where no sensor position is known, ask again with the source's normals turned over "
        "whenever the answer is not ok",
    )
    repeat_below: float = Field(
        0.97,
        ge=0,
        le=1,
        description="an answer of less confidence is sought once more, from the start, on a shifted grid, and both "
        "answers decide; up to checked_below one that has a rival or few matches too; ok from min_confidence on; 0: "
        "none is",
    )
    mirror: bool = Field(
        True,
        description="ask once more with the source mirrored where the answer is not quite sure, to say so",
    )

    @field_validator("grids")
    @classmethod
    def _check(cls, grids: tuple[float, ...]) -> tuple[float, ...]:
        if any(grid <= 1 for grid in grids):
            raise ValueError("a second look is on coarser grids: factors must be above 1")
        return grids


class RefinementConfig(PartConfig):
    """Refinement of the best hypotheses."""

    name: str = Field(
        "gicp",
        description="icp is point-to-plane; gicp came two to four times closer on generated scans at the same "
        "cost; svd fits the weighted correspondences anew and needs no clouds; none; or a class of your own",
    )
    max_distance: float = Field(1.5, gt=0, description="largest distance of matched points, in voxels")
    max_iterations: int = Field(10, ge=1, description="most steps of the last course of the refinement")
    parallel: bool = Field(
        True,
        description="in the end the answer is turned so that walls and floors of both scans are parallel, as far as "
        "the surfaces that they share leave that open; with gicp and icp",
    )


class DecisionConfig(Section):
    """When an answer may be called ok."""

    min_confidence: float = Field(0.95, ge=0, le=1, description="below it the status is low_confidence")
    ambiguity_ratio: float = Field(
        0.8, gt=0, le=1, description="a distinct second hypothesis this good makes the answer ambiguous"
    )
    prior: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="share of the pairs you ask that do overlap, where you know it: the confidence is for such a mix; "
        "None: nine in ten do, as in the mix that it was fitted on, or fewer where a batch shows it",
    )


class RegistrationConfig(Section):
    """Everything that decides a registration besides the two clouds."""

    voxel_size: float | None = Field(None, gt=0, description="cloud units; None chooses and reports one")
    seed: int = Field(0, ge=0, description="same files, same seed: same answer")
    scale: Literal["fixed", "estimate"] = Field(
        "fixed",
        description="fixed: both clouds are in one unit; estimate: the ratio of their lengths is unknown, 1/1000 to "
        "1000, and the answer is a similarity",
    )
    preparation: PreparationConfig = PreparationConfig()
    descriptor: DescriptorConfig = DescriptorConfig()
    matching: MatchingConfig = MatchingConfig()
    filter: FilterConfig = FilterConfig()
    estimator: EstimatorConfig = EstimatorConfig()
    scoring: ScoringConfig = ScoringConfig()
    refinement: RefinementConfig = RefinementConfig()
    second_look: SecondLookConfig = SecondLookConfig()
    decision: DecisionConfig = DecisionConfig()
    expert: ExpertConfig = ExpertConfig()


MOVED = {
    "judgement": "decision",
    "verification": "scoring",
    "verification.enabled": "scoring.scorers ([] for false)",
    "preparation.feature_radius": "descriptor.radius",
    "preparation.feature_neighbors": "descriptor.neighbors",
    "matching.method": "matching.name",
    "refinement.method": "refinement.name",
}
"""Keys of version 0.1.0 and where they stand now."""
