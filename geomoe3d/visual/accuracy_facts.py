"""An answer and how accurate it is, in words: the same on the console, in pictures, on pages and in notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.runtime.words import counted

if TYPE_CHECKING:
    from geomoe3d.result import RegistrationResult


def length(value: float, unit: str, form: str = ".6g") -> str:
    """A length in words, with the name of its unit where that is known."""
    return f"{value:{form}} {unit}".rstrip()


def accuracy_facts(result: RegistrationResult, unit: str = "") -> list[tuple[str, str]]:
    """Name and text of each figure, lengths in the files' unit; no more than the overlap where nothing was measured."""
    found = result.accuracy
    facts = [] if result.scale == 1.0 else [("scale", _scale(result))]
    if found is None:
        overlap = (
            f"{100 * result.overlap:.0f} % of the source" if np.isfinite(result.overlap) else "not known"
        )
        return [*facts, ("overlap", overlap)]
    near, far = found.sigma_center, found.sigma_farthest
    guess = "" if unit else " if the unit is the metre"
    # Fewer than a thousandth of a millimetre no scanner measures, so the unit is no metre; a whole metre says more.
    small = 1000.0 * near >= 1e-3 and far < 1
    metres = f" ({near * 1000.0:.3g} and {far * 1000.0:.3g} mm{guess})" if small else ""
    held = "one standard deviation" if result.ok else "one standard deviation, if the answer is right"
    return [
        *facts,
        (
            "overlap",
            f"{100 * found.overlap_source:.0f} % of the source, {100 * found.overlap_target:.0f} % of the target",
        ),
        (
            "surfaces",
            f"distance mean {found.distance_mean:.3g}, median {found.distance_median:.3g}, standard deviation "
            f"{found.distance_std:.3g}, 95 % within {length(found.distance_p95, unit, '.3g')}",
        ),
        (
            "uncertainty",
            f"{held}: {length(near, unit, '.3g')} at the overlap's centre, {length(far, unit, '.3g')} at the farthest "
            f"point, {found.sigma_rotation_deg:.2g} deg{metres if unit in ('', 'm') else ''}",
        ),
        ("matches", _rmse(found.inlier_rmse, unit)),
    ]


def margin_facts(result: RegistrationResult) -> list[tuple[str, str]]:
    """Names and texts of the margin and of the answer on another grid, as far as these were asked for."""
    margin, agree = (result.evidence.get(name) for name in ("margin", "answers_agree"))
    facts = []
    if margin is not None:
        this, other = ("this transform", "the best different one")[:: 1 if margin >= 0 else -1]
        said = f"the second look prefers {this} to {other} by a factor of {np.exp(abs(margin)):.3g}"
        facts.append(("margin", said))
    if agree is not None:
        first, second = (result.evidence[f"confidence_{name}"] for name in ("first", "second"))
        same = "the same transform" if agree else "two different transforms"
        said = f"registered on two grids, which gave {same} (confidence {first:.2f} and {second:.2f})"
        facts.append(("second grid", said))
    return facts


def _rmse(value: float, unit: str) -> str:
    if not np.isfinite(value):
        return "none is an inlier"
    return f"RMSE {length(value, unit, '.3g')}, not the accuracy (that is the uncertainty)"


def _scale(result: RegistrationResult) -> str:
    sigma = result.evidence.get("scale_sigma")
    unsure = "" if sigma is None else f" +- {100 * sigma:.1f} %"
    return f"{result.scale:.6g}{unsure}: lengths of the source times this are those of the target"


def paragraph(result: RegistrationResult) -> str:
    """The answer in one paragraph, which begins with its status."""
    words = f"{result.status}, confidence {result.confidence:.2f}"
    names = f"'{result.source.name}' into '{result.target.name}'"
    if not result.has_transform:
        return "; ".join([f"{words}: no transform that maps {names} was found", *result.reasons])
    from geomoe3d.geometry.se3 import inverse, rotation_angle_deg, transform_points

    T = result.T_target_source
    words += f": maps {names}, turned by {rotation_angle_deg(T[:3, :3] / result.scale):.1f} degrees"
    if result.scale != 1.0:
        words += f", scaled by {result.scale:.6g}"
    center = result.information_center[None]
    if np.isfinite(center).all():
        step = np.linalg.norm(center - transform_points(inverse(T, result.scale), center))
        words += f" and shifted by {step:.3g}"
    overlap = result.overlap if result.accuracy is None else result.accuracy.overlap_source
    words += (
        f"; {100 * overlap:.0f} % of the source lies on the target, {result.num_inliers:,} of "
        f"{counted(result.num_correspondences, 'correspondence')} agree within {result.inlier_threshold:.3g}"
    )
    if result.ok and (found := result.accuracy) is not None:
        words += (
            f"; uncertainty, one standard deviation: {found.sigma_center:.2g} at the centre of the overlap and "
            f"{found.sigma_rotation_deg:.2g} degrees"
        )
    return "; ".join([words, *result.reasons])
