"""How accurate an answer is, in words: the same on the console, in pictures and on pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from geomoe3d.result import RegistrationResult

_MILLIMETRES = 1000.0


def length(value: float, unit: str, form: str = ".6g") -> str:
    """A length in words, with the name of its unit where that is known."""
    return f"{value:{form}} {unit}".rstrip()


def accuracy_facts(result: RegistrationResult, unit: str = "") -> list[tuple[str, str]]:
    """Name and text of each figure, lengths in the files' unit; no more than the overlap where nothing was measured."""
    found = result.accuracy
    facts = [] if result.scale == 1.0 else [("scale", _scale(result))]
    if found is None:
        overlap = f"{result.overlap:.0%} of the source" if np.isfinite(result.overlap) else "not known"
        return [*facts, ("overlap", overlap)]
    near, far = found.sigma_center, found.sigma_farthest
    guess = "" if unit else " if the unit is the metre"
    metres = f" ({near * _MILLIMETRES:.3g} and {far * _MILLIMETRES:.3g} mm{guess})"
    held = "one deviation" if result.ok else "one deviation, if the answer is right"
    return [
        *facts,
        ("overlap", f"{found.overlap_source:.0%} of the source, {found.overlap_target:.0%} of the target"),
        ("inlier RMSE", length(found.inlier_rmse, unit, ".3g")),
        (
            "distance",
            f"mean {found.distance_mean:.3g}, median {found.distance_median:.3g}, standard deviation "
            f"{found.distance_std:.3g}, 95 % within {length(found.distance_p95, unit, '.3g')}",
        ),
        (
            "uncertainty",
            f"{held}: {length(near, unit, '.3g')} at the overlap's centre, {length(far, unit, '.3g')} at the farthest "
            f"point, {found.sigma_rotation_deg:.2g} deg{metres if unit in ('', 'm') else ''}",
        ),
    ]


def _scale(result: RegistrationResult) -> str:
    sigma = result.evidence.get("scale_sigma")
    unsure = "" if sigma is None else f" +- {100 * sigma:.1f} %"
    return f"{result.scale:.6g}{unsure}: lengths of the target over those of the source"
