"""Scores of made-up pairs, for what is counted over them."""

from __future__ import annotations

import math

from geomoe3d.evaluation.records import PairScore


def scored(
    confidence: float | None, right: bool, scene: str = "room", status: str | None = None
) -> PairScore:
    return PairScore(
        pair="p",
        scene=scene,
        overlap=None,
        inlier_ratio=None,
        rotation_error_deg=1.0,
        translation_error=0.1,
        right=right,
        right_20=right,
        rmse=None,
        any_right=right,
        precision=None,
        recall=None,
        f1=None,
        verified_precision=None,
        verified_recall=None,
        verified_f1=None,
        confidence=confidence,
        status=status,
        seconds=0.1,
        stages={},
        peak_memory=None,
    )


def undefined(interval: tuple[float, float]) -> bool:
    return math.isnan(interval[0]) and math.isnan(interval[1])
