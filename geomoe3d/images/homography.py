"""The homography between two photographs of a plane, or from one place: weighted DLT, RANSAC, MAGSAC++."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from geomoe3d.geometry.homography import MIN_MATCHES, weighted_dlt
from geomoe3d.images.cameras import robust_estimator
from geomoe3d.images.config import HOMOGRAPHY
from geomoe3d.images.features import checked, halves_of, random_halves
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
    kept = np.flatnonzero(w > 0)
    few = len(kept) < MIN_MATCHES
    H = None if few else _estimate(pixels[kept], w[kept], estimator, threshold, seed)
    if H is None:
        reason = "the matches fix no homography: at least four of them must lie at places of which no three are in line"
        if few:
            reason = f"{len(kept)} matches are kept of {len(pixels)}; at least {MIN_MATCHES} are needed"
        none = np.zeros(len(pixels), dtype=bool)
        return HomographyResult("failed", (reason,), None, none, np.full(len(pixels), np.inf))
    apart = np.linalg.norm(map_points(H, pixels[:, :2]) - pixels[:, 2:], axis=1)
    residuals = np.where(np.isfinite(apart), apart, np.inf)
    inliers = np.asarray((residuals < threshold) & (w > 0))
    reasons = _doubts(H, pixels[np.isfinite(pixels).all(axis=1)], pixels[inliers], threshold)
    return HomographyResult("low_confidence" if reasons else "ok", tuple(reasons), H, inliers, residuals)


def _estimate(
    pixels: FloatArray, w: FloatArray, estimator: str, threshold: float, seed: int
) -> FloatArray | None:
    if estimator == "dlt":
        found, fixed = weighted_dlt(torch.from_numpy(pixels), torch.from_numpy(w))
        H = found.numpy() if bool(fixed) else None
    else:
        cv2, method = robust_estimator(estimator, seed, "dlt")
        H, _ = cv2.findHomography(*halves_of(pixels), method, threshold, maxIters=2000, confidence=0.99999)
    if H is None or not np.isfinite(H).all() or abs(np.linalg.det(H / np.linalg.norm(H))) < 1e-12:
        return None
    return np.asarray(H / (H[2, 2] if abs(H[2, 2]) > 1e-12 else 1.0))


def _doubts(H: FloatArray, matches: FloatArray, inliers: FloatArray, threshold: float) -> list[str]:
    """Why a homography may be wrong, of all matches (N, 4) and its inliers (K, 4)."""
    reasons = []
    if len(inliers) < HOMOGRAPHY.least_inliers:
        few = f"{len(inliers)} inliers; below {HOMOGRAPHY.least_inliers}"
        reasons.append(f"{few} a wrong homography finds as many")
    elif np.linalg.matrix_rank(inliers[:, :2] - inliers[:, :2].mean(axis=0), tol=10 * threshold) < 2:
        reasons.append("the inliers lie in line or at one place, and fix the homography nowhere else")
    (left, top), (right, bottom) = matches[:, :2].min(axis=0), matches[:, :2].max(axis=0)
    extent = np.array([[left, top], [left, bottom], [right, top], [right, bottom]])
    corners = map_points(H, extent)
    if not np.isfinite(corners).all():
        reasons.append("it sends a part of the first image behind the camera")
    if not reasons:
        halves = map(torch.from_numpy, random_halves(inliers))
        others = [map_points(weighted_dlt(x, torch.ones(len(x)))[0].numpy(), extent) for x in halves]
        off = float(np.nan_to_num(np.abs(np.array(others) - corners), nan=np.inf).max())
        if off > HOMOGRAPHY.most_between_halves * threshold:
            reasons.append(f"half of the inliers alone move a corner of what is matched by {off:.0f} pixels")
        limit = HOMOGRAPHY.most_deviation * threshold
        if (spread := float(deviations(H, inliers, extent).max())) > limit:
            reasons.append(
                f"the inliers hold a corner of what is matched no closer than {spread:.0f} pixels (one standard "
                f"deviation; {limit:.3g} are allowed): they are few, or lie in a small part of the image or nearly in "
                "line"
            )
    return reasons


def deviations(H: FloatArray, matches: FloatArray, pixels: FloatArray) -> FloatArray:
    """(M,) standard deviation, pixels, of where H puts pixels (M, 2), if it is the best fit of matches (N, 4) whose
    errors are as large as their residuals; infinite where these do not fix H."""
    scale = np.array([*[1 / np.abs(matches[:, :2]).max(initial=1.0)] * 2, 1.0] * 3)  # of the columns of H
    residuals = map_points(H, matches[:, :2]) - matches[:, 2:]
    variance = (residuals**2).sum() / max(2 * len(matches) - 8, 1)  # of one coordinate
    rows = (_slopes(H, matches[:, :2]) * scale).reshape(-1, 9)
    # H times a number is the same homography: that direction, the ninth, stands for none.
    _, values, directions = np.linalg.svd(rows, full_matrices=False)
    if len(values) < 9 or not values[7] > 1e-9 * values[0]:
        return np.full(len(pixels), np.inf)
    moved = (_slopes(H, pixels) * scale) @ (directions[:8] / values[:8, None]).T
    found: FloatArray = np.sqrt(variance * (moved**2).sum(axis=(1, 2)))
    return found


def _slopes(H: FloatArray, pixels: FloatArray) -> FloatArray:
    """(N, 2, 9) by how much pixels move under H with each of its numbers."""
    points = np.column_stack([pixels, np.ones(len(pixels))])
    share = points / (points @ H[2])[:, None]
    none = np.zeros_like(share)
    u, v = map_points(H, pixels).T
    return np.stack(
        [np.hstack([share, none, -u[:, None] * share]), np.hstack([none, share, -v[:, None] * share])], axis=1
    )


def map_points(H: FloatArray, pixels: FloatArray) -> FloatArray:
    """H applied to pixels (N, 2); NaN for those at infinity or beyond, seen from where most of them go."""
    moved = np.column_stack([pixels, np.ones(len(pixels))]) @ H.T
    sign = np.sign(np.nanmedian(moved[:, 2])) if len(moved) else 1.0
    depth = np.where(moved[:, 2] * sign > 1e-12, moved[:, 2], np.nan)
    mapped: FloatArray = moved[:, :2] / depth[:, None]
    return mapped


def corner_error(H: FloatArray | None, truth: FloatArray, size: tuple[int, int]) -> float:
    """Mean distance, pixels, of the four corners of an image (width, height) under H and under the truth.

    Infinite without H and where H sends a corner behind the camera."""
    if H is None:
        return float("inf")
    w, h = size[0] - 1.0, size[1] - 1.0
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]])
    apart = np.linalg.norm(map_points(H, corners) - map_points(truth, corners), axis=1)
    return float(np.nan_to_num(apart, nan=np.inf).mean())
