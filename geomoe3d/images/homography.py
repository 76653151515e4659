"""The homography between two photographs of a plane, or from one place: weighted DLT, RANSAC, MAGSAC++."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from geomoe3d.errors import InputError
from geomoe3d.geometry.homography import MIN_MATCHES, weighted_dlt
from geomoe3d.images.cameras import opencv
from geomoe3d.images.config import HOMOGRAPHY
from geomoe3d.images.features import checked
from geomoe3d.types import BoolArray, FloatArray


@dataclass(frozen=True)
class HomographyResult:
    """The answer for two images of a plane.

    Attributes:
        status: ``ok``; ``low_confidence``: it may be wrong; ``failed``: there is none.
        reasons: why it is not ok.
        H: (3, 3) with H[2, 2] = 1 where that is not 0, pixel1 ~ H pixel0; None where failed.
        inliers: (N,) bool, matches within the threshold.
        residuals: (N,) distance of H pixel0 to pixel1, pixels; inf where failed or behind.
    """

    status: Literal["ok", "low_confidence", "failed"]
    reasons: tuple[str, ...]
    H: FloatArray | None
    inliers: BoolArray
    residuals: FloatArray


def find_homography(
    pixels: FloatArray,
    *,
    weights: FloatArray | None = None,
    estimator: Literal["magsac", "ransac", "dlt"] = "magsac",
    threshold: float = HOMOGRAPHY.threshold,
    seed: int = 0,
) -> HomographyResult:
    """The homography that matches (N, 4) = [u0, v0, u1, v1] agree on; arguments as of `geomoe3d.images.pose`.
    Raises InputError: shapes do not fit, a threshold that is not positive, or an unknown estimator."""
    pixels, w = checked(pixels, weights, threshold, seed)
    usable = np.isfinite(pixels).all(axis=1)
    kept = np.flatnonzero(w > 0)
    nothing = HomographyResult("failed", (), None, np.zeros(len(pixels), bool), np.full(len(pixels), np.inf))
    if len(kept) < MIN_MATCHES:
        reason = f"{len(kept)} matches are kept of {len(pixels)}; at least {MIN_MATCHES} are needed"
        return HomographyResult("failed", (reason,), None, nothing.inliers, nothing.residuals)
    if estimator == "dlt":
        found, fixed = weighted_dlt(torch.from_numpy(pixels[kept]), torch.from_numpy(w[kept]))
        H = found.numpy() if bool(fixed) else None
    elif estimator in ("ransac", "magsac"):
        cv2 = opencv()
        cv2.setRNGSeed(seed)
        method = cv2.RANSAC if estimator == "ransac" else cv2.USAC_MAGSAC
        first, second = (np.ascontiguousarray(pixels[kept, k : k + 2]) for k in (0, 2))
        H, _ = cv2.findHomography(first, second, method, threshold, maxIters=2000, confidence=0.99999)
    else:
        raise InputError(f"there is no estimator '{estimator}'; there are magsac, ransac and dlt")
    if H is None or not np.isfinite(H).all() or abs(np.linalg.det(H / np.linalg.norm(H))) < 1e-12:
        reason = "the matches fix no homography: at least four of them must lie at places of which no three are in line"
        return HomographyResult("failed", (reason,), None, nothing.inliers, nothing.residuals)
    H = H / (H[2, 2] if abs(H[2, 2]) > 1e-12 else 1.0)
    residuals = np.where(usable, np.linalg.norm(map_points(H, pixels[:, :2]) - pixels[:, 2:], axis=1), np.inf)
    residuals = np.nan_to_num(residuals, nan=np.inf)
    inliers = (residuals < threshold) & (w > 0)
    reasons = []
    if inliers.sum() < HOMOGRAPHY.least_inliers:
        reasons.append(
            f"{inliers.sum()} inliers; below {HOMOGRAPHY.least_inliers} a wrong homography finds as many"
        )
    elif (
        np.linalg.matrix_rank(pixels[inliers, :2] - pixels[inliers, :2].mean(axis=0), tol=10 * threshold) < 2
    ):
        reasons.append("the inliers lie in line or at one place, and fix the homography nowhere else")
    extent = np.array([[x, y] for x in _range(pixels[usable, 0]) for y in _range(pixels[usable, 1])])
    corners = map_points(H, extent)
    if not np.isfinite(corners).all():
        reasons.append("it sends a part of the first image behind the camera")
    if not reasons:
        off, order = 0.0, np.random.default_rng(0).permutation(np.flatnonzero(inliers))
        for half in (order[::2], order[1::2]):
            other, _ = weighted_dlt(torch.from_numpy(pixels[half]), torch.ones(len(half)))
            off = max(
                off,
                float(np.nan_to_num(np.abs(map_points(other.numpy(), extent) - corners), nan=np.inf).max()),
            )
        if off > HOMOGRAPHY.most_between_halves * threshold:
            reasons.append(f"half of the inliers alone move a corner of what is matched by {off:.0f} pixels")
    return HomographyResult("low_confidence" if reasons else "ok", tuple(reasons), H, inliers, residuals)


def map_points(H: FloatArray, pixels: FloatArray) -> FloatArray:
    """H applied to pixels (N, 2); NaN for those at infinity or beyond, seen from where most of them go."""
    moved = np.column_stack([pixels, np.ones(len(pixels))]) @ H.T
    sign = np.sign(np.nanmedian(moved[:, 2])) if len(moved) else 1.0
    depth = np.where(moved[:, 2] * sign > 1e-12, moved[:, 2], np.nan)
    mapped: FloatArray = moved[:, :2] / depth[:, None]
    return mapped


def corner_error(H: FloatArray | None, truth: FloatArray, size: tuple[int, int]) -> float:
    """Mean distance, pixels, of the four corners of an image (width, height) under H and under the truth.

    Infinite without H and where H sends a corner behind the camera.
    """
    if H is None:
        return float("inf")
    w, h = size[0] - 1.0, size[1] - 1.0
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]])
    return float(
        np.nan_to_num(
            np.linalg.norm(map_points(H, corners) - map_points(truth, corners), axis=1), nan=np.inf
        ).mean()
    )


def _range(values: FloatArray) -> tuple[float, float]:
    return float(values.min()), float(values.max())
