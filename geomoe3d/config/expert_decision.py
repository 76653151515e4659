"""Constants of the last step, decide: which hypothesis, how sure, how accurate, at which scale, and what is said."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from geomoe3d.config.section import Section, constant

_REAL_PAIRS = "right answers on real scans"


class SelectionExpert(Section):
    """Which hypothesis is the answer, and which is its rival (`decision/selection.py`)."""

    most_rivals: int = constant(
        3, "hypotheses", (1, 20), "refined where they come close, before the best is taken for the rival"
    )
    kept_evidence: float = constant(
        0.8, "share", (0, 1), "a refinement that leaves less of the score of the clouds is thrown away"
    )
    most_rounds: int = constant(
        6,
        "rounds",
        (1, 100),
        "further hypotheses shown, one by one, to a scorer that rejects what the clouds like",
    )
    settled_lead: float = constant(
        1.5,
        "ratio of surface scores",
        (1, 1000),
        "from which clouds and correspondences that like one transform need no network",
        "of 210 recorded pairs 92 had it; all were right, and the network said the same",
    )
    different_shift: float = constant(
        3.0, "inlier thresholds", (0.1, 100), "shift at the centroid from which two transforms are different"
    )
    different_turn_deg: float = constant(
        15.0, "degrees", (0.1, 180), "turn from which two transforms are different", "limit of the benchmark"
    )
    far_apart: float = constant(
        3.0, "factor", (1, 100), "times both, from which transforms are not made parallel to be compared"
    )
    most_unrefined: float = constant(
        0.5,
        "probability",
        (0, 1),
        "most confidence of an answer that cannot be refined, where no sensor is known",
        "of 139 answers that were ok on real scans one had not been refined, and its sensors were known",
    )


class TwinsExpert(Section):
    """Other places that look like the answer's (`decision/twins.py`, `decision/selection.py`)."""

    least_behind: float = constant(
        0.01,
        "share",
        (0, 1),
        "of the points that a scan which looks all around has behind the sensor, seen along its mean ray",
        "none of 80 fragments of depth cameras, 0.01 and more of scanners in rooms",
    )
    cell: float = constant(2.0, "voxels", (0.5, 20), "edge of the cells that are laid on each other")
    most_cells: int = constant(
        2**22,
        "cells",
        (1000, 2**30),
        "of a grid, beyond which what lies far from the shared surface is left out",
    )
    least_shift: float = constant(
        3.0, "cells", (0, 100), "by which a place that is not turned is another one"
    )
    most_shifts: int = constant(3, "shifts", (1, 100), "of each turn that are looked at")
    most_asked: int = constant(
        12, "transforms", (1, 1000), "under which most cells coincide, that the clouds are asked about"
    )
    least_common: float = constant(
        0.5, "ratio", (0, 1), "of the cells that coincide to those under the answer, below which none is"
    )
    most_refined: int = constant(3, "transforms", (1, 20), "that the clouds like best are refined")
    least_proposed: float = constant(
        0.2, "ratio", (0, 1), "of the answer's surface score from which a transform is refined"
    )
    least_score: float = constant(
        0.4,
        "ratio",
        (0, 1),
        "of the answer's surface score from which a refined one makes it ambiguous",
        "0.44 to 0.96 of 20 wrong answers that were ok in generated places that repeat",
    )
    believed: float = constant(
        0.95, "probability", (0, 1), "that the clouds alone give it if the answer were not there"
    )


class SharedSurfaceExpert(Section):
    """Where two clouds lie on each other (`decision/shared_surface.py`)."""

    least_cosine: float = constant(
        0.7, "cosine", (0, 1), "normals of one surface, estimated twice, differ by less than 45 degrees"
    )
    most_asked: int = constant(4000, "points", (100, 1_000_000), "of each cloud that are looked at")
    few_asked: int = constant(800, "points", (100, 1_000_000), "of each cloud in the first rounds of a fit")
    cut: float = constant(4.0, "robust deviations", (1, 100), "gaps beyond count for nothing")
    least_deviation: float = constant(
        0.05, "voxels", (0, 1), "least robust deviation of gaps: means of a grid are no better"
    )


class AccuracyExpert(Section):
    """How far off an answer may be (`decision/accuracy.py`)."""

    least_points: int = constant(60, "points", (12, 100_000), "on each other below which no figure is given")
    residual_turn: float = constant(
        0.36,
        "-",
        (0, 100),
        "weight of one residual in the error of the rotation",
        "scripts/measure_accuracy.py",
    )
    residual_shift: float = constant(
        0.84, "-", (0, 100), "the same of the translation", "scripts/measure_accuracy.py"
    )
    bend_turn: float = constant(
        1.1, "-", (0, 100), "what a bend adds to the error of the rotation", "scripts/measure_accuracy.py"
    )
    bend_shift: float = constant(
        1.2, "-", (0, 100), "the same of the translation", "scripts/measure_accuracy.py"
    )
    small_strain: float = constant(
        0.006,
        "strain",
        (1e-6, 1),
        "bend at which gaps are half as dependent as they can be",
        "scripts/measure_accuracy.py",
    )


class ParallelExpert(Section):
    """Main directions of two clouds made parallel (`decision/parallel.py`)."""

    most_asked: int = constant(1500, "points", (100, 1_000_000), "of each cloud whose normals are looked at")
    width_deg: float = constant(
        6.0, "degrees", (0.5, 20), "of a direction: normals on a grid of noisy points are off by as much"
    )
    least_share: float = constant(0.04, "share", (0, 1), "of the normals within twice the width")
    least_density: float = constant(
        0.5,
        "share",
        (0, 1),
        "of these within the width: a quarter for what is evenly round, more than this for a plane",
    )
    most_directions: int = constant(8, "directions", (1, 50), "of one cloud")
    num_seeds: int = constant(50, "normals", (1, 10_000), "of which the one with most others near begins")
    shifts: int = constant(4, "steps", (1, 100), "towards the mean of the normals around")
    right_deg: float = constant(
        5.0, "degrees", (0, 45), "off a right angle at which a third direction is added to two"
    )
    reach_deg: float = constant(15.0, "degrees", (0, 45), "within which two directions are taken for one")
    sigma_deg: float = constant(
        2.0, "degrees", (0.01, 45), "standard deviation of one scan's direction against the other's"
    )
    cut: float = constant(3.0, "standard deviations", (0.1, 100), "apart at which a pair counts a quarter")
    rounds: int = constant(4, "rounds", (1, 100), "of weighing anew")


class ScaleExpert(Section):
    """Whether two clouds are of one size (`decision/scale.py`)."""

    reaches: Annotated[tuple[Annotated[float, Field(gt=0, le=100)], ...], Field(min_length=1)] = constant(
        (3.0, 3.0, 3.0, 2.5, 2.5, 2.0, 2.0, 1.5, 1.5, 1.5, 1.5, 1.5),
        "voxels",
        None,
        "how far nearest neighbours are sought from round to round, wide enough at first for a scale of 0.8",
    )
    thorough_rounds: int = constant(4, "rounds", (1, 100), "the last ones, which ask all points")
    settled: float = constant(
        5e-4,
        "ln(ratio)",
        (0, 0.1),
        "a change that ends them",
        "a twentieth of what the bending of scans leaves open",
    )
    nearly_settled: float = constant(
        2e-3, "ln(ratio)", (0, 0.1), "a change that ends the rounds of few points"
    )
    least_points: int = constant(60, "points", (7, 100_000), "on each other, for seven unknowns")
    smallest: float = constant(0.3, "ratio", (0.01, 1), "a fit that shrinks the source further has run away")
    largest: float = constant(3.0, "ratio", (1, 100), "a fit that grows the source further has run away")
    per_distortion: float = constant(
        0.8, "-", (0, 100), "error of the scale over the distortion", "fitted on generated rooms"
    )
    per_formal: float = constant(
        4.5,
        "-",
        (0, 100),
        "error of the fit over what independent points would leave",
        "fitted on generated rooms; docs/measurements.md holds what came of it on real fragments",
    )
    significant: float = constant(
        2.6, "standard deviations", (0, 100), "by which a scale that differs is off 1", _REAL_PAIRS
    )
    tolerated: float = constant(0.01, "ln(ratio)", (0, 1), "no smaller difference counts", _REAL_PAIRS)
    usual: float = constant(
        0.035,
        "ln(ratio)",
        (0, 1),
        "below it more standard deviations are needed",
        "fragments of one room, fused from a depth camera, differ by 1.6 % among themselves (standard deviation)",
    )
    significant_usual: float = constant(
        3.5,
        "standard deviations",
        (0, 100),
        "by which such a difference is off 1",
        "32 right answers of both benchmarks that 2.6 denied: 18 have it; of 20 pairs scaled by 1.02 one more is ok",
    )
    unheard_of: float = constant(
        0.05,
        "ln(ratio)",
        (0, 1),
        "beyond it half as many standard deviations do",
        "right answers on real fragments, firmly measured, are hardly off by more than 5 per cent",
    )
    firm: float = constant(
        0.08, "ln(ratio)", (0, 1), "but only where the deviation is below this", _REAL_PAIRS
    )
    unit_tolerance: float = constant(0.02, "ln(ratio)", (0, 0.5), "within which a ratio is that of two units")
    extent_tolerance: float = constant(
        1.5, "factor", (1, 5), "within which a ratio of extents is; twice applied it leads to no other unit"
    )


class SimilarityExpert(Section):
    """Search for an unknown scale (`decision/similarity.py`)."""

    step: float = constant(1.2, "factor", (1.01, 2), "between rungs: registration bears a fifth in scale")
    rungs: int = constant(7, "rungs", (1, 100), "above and below the ratio of the extents")
    largest: float = constant(1100.0, "ratio", (1, 1e6), "most that is tried, and one over it least")
    promising: float = constant(
        0.3, "probability", (0, 1), "confidence from which the surfaces are believed to say the ratio"
    )
    most_settling: int = constant(4, "registrations", (1, 100), "at the ratio that the last one gave")
    settled: float = constant(0.002, "ln(ratio)", (0, 0.5), "a change that ends them")
    most_thorough: int = constant(2, "ratios", (0, 100), "that get all looks where no rung was ok")
    same: float = constant(0.02, "ln(ratio)", (0, 0.5), "closer ratios are one")


class CausesExpert(Section):
    """What is wrong with a pair as a whole (`decision/causes.py`, `decision/answer.py`)."""

    least_believed: float = constant(
        0.3, "probability", (0, 1), "an answer of less confidence says nothing of the scale"
    )
    most_doubted: float = constant(
        0.79,
        "probability",
        (0, 1),
        "most confidence of an answer whose scale differs or whose source is mirrored",
    )
    sure: float = constant(0.99, "probability", (0, 1), "an ok answer above it is not tried mirrored")
    mirrored_matches: int = constant(
        500, "matches", (3, 1_000_000), "that a mirrored source is given to agree with a few transforms"
    )
    mirrored_support: float = constant(
        0.028,
        "votes per match",
        (0, 1),
        "of the best of a few transforms, below which no mirrored source is looked at",
        "0.012 to 0.028 by chance, and 0.036 to 0.15 of mirrored pairs that fit, among 31 recorded pairs",
    )
    mirrored_lead: float = constant(
        3.0, "ratio of scores", (1, 1000), "by which a mirrored source must fit better"
    )
    mirrored_surfaces: float = constant(
        1.7,
        "ratio of surface scores",
        (1, 1000),
        "by which it must fit better by the clouds alone",
        "0.7 to 1.6 of five pairs of a hotel room with repeated furniture, 1.8 to 14 of 13 pairs that were mirrored",
    )


class RemarksExpert(Section):
    """When something is said of the input (`decision/remarks.py`)."""

    flat: float = constant(1e-6, "thickness / extent", (0, 1), "of what has no surface in space")
    least_no_data: int = constant(
        3, "points", (1, 1_000_000), "with one number that stands for no measurement"
    )
    unusual_size: float = constant(3.0, "factor", (1, 1000), "off the voxel size that would be chosen")
    few_voxels: int = constant(100, "voxels", (0, 100_000), "far below what a chosen grid aims at")
