"""Constants of the confidence and of the verdict: the fit, the bounds of its inputs, and the limits of `ok`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from geomoe3d.config.section import Section, constant

_FIT = "scripts/fit_confidence.py; docs/measurements.md holds what came of it on real scans"
_SECOND_FIT = (
    "scripts/fit_confidence.py --second-look; docs/measurements.md holds what came of it on real scans"
)
_REPEAT_FIT = "scripts/fit_confidence.py --repeat; docs/measurements.md holds what came of it on real scans"
_REAL_PAIRS = "right answers on real scans"
Slope = Annotated[float, Field(ge=-1000, le=1000)]
Slopes = tuple[Slope, Slope, Slope, Slope, Slope, Slope, Slope]


class ConfidenceFit(Section):
    """A logistic function of the evidence, in the order of `decision.confidence.CONFIDENCE_INPUTS`."""

    offset: float = constant(0.0, "logit", (-50, 50), "where every input is 0", _FIT)
    slopes: Slopes = constant(
        (0.0,) * 7,
        "logit per input",
        None,
        "log evidence, log lead, log overlap, log observability, log looseness, log support, free-space violation",
        _FIT,
    )


class MarginFit(Section):
    """A logistic function of what the fit of the evidence says and of the surface network's margin."""

    offset: float = constant(0.0, "logit", (-50, 50), "where both are 0", _SECOND_FIT)
    evidence: float = constant(1.0, "logit per logit", (0, 10), "of what the evidence says", _SECOND_FIT)
    margin: float = constant(0.0, "-", (0, 10), "of the margin, see `judge`", _SECOND_FIT)
    most_evidence: float = constant(8.0, "logit", (0, 50), "for and against, beyond which it says no more")
    least_margin: float = constant(-2.5, "-", (-50, 0), "below which less says no more")
    most_margin: float = constant(4.0, "-", (0, 50), "above which more says no more")


class RepeatExpert(Section):
    """A doubtful answer sought once more on a shifted grid (`decision/repeat.py`)."""

    shift: float = constant(0.5, "voxels", (0, 1), "by which the grid is shifted along each axis")
    few_matches: int = constant(
        30, "matches", (0, 100_000), "fewer that agree with an answer that is ok by little", _REAL_PAIRS
    )
    seed_step: int = constant(1000, "-", (1, 1_000_000), "from the seed to that of its draws")
    offset: float = constant(
        0.57, "logit", (-50, 50), "where the mean of both answers' logits is 0", _REPEAT_FIT
    )
    slope: float = constant(
        1.31, "logit per logit", (0, 10), "of that mean, where both answers agree", _REPEAT_FIT
    )


class ConfidenceExpert(Section):
    """How sure an answer is, and when it may be called ok (`decision/confidence.py`, `decision/information.py`).

    The fits are of generated rooms that the network was not trained on and a recorded one, mixed by overlap as the
    benchmarks are, and of unrelated pairs: 300 and 150 pairs, each with one look and with two.
    """

    with_network: ConfidenceFit = ConfidenceFit(
        # 0.3 lower than fitted: since then what refines to the answer itself is no rival, and leads are longer.
        offset=-1.433,
        slopes=(0.954, 0.998, -3.072, 0.794, -2.45, 0.658, -74.012),
    )
    # Without a network a clear lead makes up for it.
    surfaces_alone: ConfidenceFit = ConfidenceFit(
        offset=-1.216, slopes=(0.888, 2.244, -3.972, 0.435, -3.014, 1.249, -74.871)
    )
    # Where it is not known what must be empty, the same evidence is worth less.
    with_network_no_sensor: ConfidenceFit = ConfidenceFit(
        offset=-7.984, slopes=(1.953, 1.534, -4.965, 0.444, -2.722, 0.169, 0.0)
    )
    surfaces_alone_no_sensor: ConfidenceFit = ConfidenceFit(
        offset=-1.976, slopes=(1.813, 3.895, -5.902, 1.117, -2.994, 1.447, 0.0)
    )
    # Of clouds that were described again, with the network's margin; of scans whose sensors are known.
    second_look: MarginFit = MarginFit(offset=-0.523, evidence=0.344, margin=0.952)
    fitted_prior: float = constant(
        0.88,
        "probability",
        (0.01, 0.99),
        "that a pair overlaps, in the mix of the fit",
        "300 related pairs, and 160 unrelated ones that count a quarter each",
    )
    mix_pairs: float = constant(
        20.0,
        "pairs",
        (0, 1e6),
        "of the mix of the fit that count with those of a batch when the share that belongs together is estimated",
    )
    least_score: float = constant(1e-3, "surface score", (1e-9, 1), "below which less says no more")
    added_support: float = constant(
        0.002, "share", (1e-9, 1), "added to the share of agreeing matches before its log"
    )
    added_overlap: float = constant(0.01, "share", (1e-9, 1), "added to the overlap before its log")
    added_observability: float = constant(1e-3, "-", (1e-9, 1), "added to the observability before its log")
    least_looseness: float = constant(0.02, "voxels", (1e-6, 1), "below which firmer says no more")
    most_looseness: float = constant(10.0, "voxels", (1, 1000), "above which looser says no more")
    least_lead: float = constant(0.5, "ratio of scores", (0.01, 1), "below which less says no more")
    most_lead: float = constant(30.0, "ratio of scores", (1, 1e6), "above which more says no more")
    unrivalled_lead: float = constant(
        3.0,
        "ratio of scores",
        (1, 1e6),
        "that stands for no rival at all: an answer without one has not beaten one",
    )
    most_violation: float = constant(0.1, "rate", (0, 1), "of free space, above which more says no more")
    asked_points: int = constant(
        200, "points", (20, 100_000), "of a scan of unknown sensor whose deviation is asked for"
    )
    least_gap: float = constant(
        0.1, "voxels", (1e-6, 1), "below which gaps between points of one grid cannot be trusted"
    )
    likely: float = constant(
        0.5, "probability", (0, 1), "from which an answer as good as its rival is ambiguous, not doubtful"
    )
    close_verdicts: float = constant(
        5.0,
        "logit",
        (0, 100),
        "verdicts of the network closer than this do not tell two transforms apart",
        "of two places that are both right it has preferred one by up to 3",
    )
    told_apart: float = constant(
        2.5,
        "-",
        (0, 100),
        "margin from which transforms that clouds and network like alike are told apart",
        "at most 0.4 between two places that are both right",
    )
    plain_matches: int = constant(
        15,
        "matches",
        (0, 1_000_000),
        "that agree with an answer which is ok by little and has no rival: then it is not checked",
        "of 266 such answers of real pairs 178 have as many and no rival, one of them far off",
    )
    most_sliding: float = constant(0.3, "probability", (0, 1), "most confidence where the source can slide")
    most_doubted: float = constant(
        0.79,
        "probability",
        (0, 1),
        "most confidence of an answer with an equal rival, or that too little agrees with",
        "below what ends a second look; of 101 such answers of recorded pairs 93 were right, of 16 others 14",
    )
    least_observability: float = constant(0.005, "-", (0, 1 / 3), "below which the source can slide")
    coinciding_sensors: float = constant(
        3.0,
        "voxels",
        (0, 1000),
        "sensors closer than this lie on each other, and their own patterns with them",
    )
    least_observability_coinciding: float = constant(
        0.03,
        "-",
        (0, 1 / 3),
        "the same where the sensors lie on each other",
        "0.007 to 0.014 in corridors; at least 0.042 of 23 right answers on real scans",
    )
    near_sensors: float = constant(
        5.0,
        "voxels",
        (0, 1000),
        "sensors closer than this may match by their patterns, where a rival fits as well",
    )
    near_sensors_rival: float = constant(
        0.35,
        "ratio",
        (0, 100),
        "of the rival's score by the surfaces to the answer's, from which on that is ambiguous",
        "of 21 wrong answers in generated car parks, rooms and pipe racks 0.37 to 1.14; of 44 right ones on real scans "
        "0.27 at most where the rival's overlap is above 0.7",
    )
    near_sensors_overlap: float = constant(
        0.7, "share", (0, 1), "of the source on the target under that rival"
    )
    least_matches: int = constant(
        6, "matches", (0, 1000), "that must agree with an ok answer", f"{_REAL_PAIRS}: at least 12"
    )
    least_points: int = constant(
        30, "points", (0, 100_000), "that must lie on each other", f"{_REAL_PAIRS}: at least 120"
    )
    low_overlap: float = constant(0.1, "share", (0, 1), "below which little shared surface is mentioned")
    high_violation: float = constant(0.1, "rate", (0, 1), "of free space from which it is mentioned")

    def fit(self, *, heard: bool, sensors_known: bool) -> ConfidenceFit:
        """The fit for an answer of which a network was asked or not, of scans whose free space is known or not."""
        if sensors_known:
            return self.with_network if heard else self.surfaces_alone
        return self.with_network_no_sensor if heard else self.surfaces_alone_no_sensor
