"""The homography between two photographs of a plane, or from one place: weighted DLT, RANSAC, MAGSAC++."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from geomoe3d.errors import InputError
from geomoe3d.images.cameras import opencv
from geomoe3d.images.epipolar import homogeneous, smallest_direction
from geomoe3d.images.features import checked
from geomoe3d.types import BoolArray, FloatArray

THRESHOLD = 3.0
"""Default inlier threshold, pixels."""

_MIN_MATCHES = 4
_LEAST_INLIERS = 15


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


def weighted_dlt(matches: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """H (..., 3, 3) of unit norm that minimises the weighted algebraic error, and whether matches fix it (...,).

    Args:
        matches: (..., N, 4), any unit.
        weights: (..., N); negative and non-finite ones count as zero.

    Source:
        Hartley and Zisserman 2004, algorithm 4.2, with weights in normalisation and equations. Differentiable;
        gradients are finite where nothing is fixed.
    """
    usable = torch.isfinite(matches).all(-1) & torch.isfinite(weights)
    x = torch.where(usable[..., None], matches, 0.0).double()
    w = torch.where(usable, weights, 0.0).clamp(min=0).double()
    w = w / w.detach().amax(-1, keepdim=True).clamp(min=1e-300)
    halves, scalings = [], []
    for half in (x[..., :2], x[..., 2:]):
        share = (w / w.sum(-1, keepdim=True).clamp(min=1e-12))[..., None]
        mean = (share * half).sum(-2, keepdim=True)
        spread = ((share * (half - mean).square()).sum((-1, -2)) / 2 + 1e-24).sqrt()[..., None, None]
        halves.append(homogeneous((half - mean) / spread))
        S = torch.eye(3, dtype=x.dtype, device=x.device).repeat(*w.shape[:-1], 1, 1)
        S = torch.cat(
            [torch.cat([S[..., :2, :2] / spread, -(mean / spread).transpose(-1, -2)], -1), S[..., 2:, :]], -2
        )
        scalings.append(S)
    first, second = halves
    zero = torch.zeros_like(first)
    rows = torch.cat([
        torch.cat([first, zero, -second[..., :1] * first], -1), torch.cat([zero, first, -second[..., 1:2] * first], -1),
    ], dim=-2)  # fmt: skip
    both = torch.cat([w, w], dim=-1)[..., None]
    vector, values = smallest_direction((rows * both).transpose(-1, -2) @ rows)
    H = torch.linalg.solve(scalings[1], vector.reshape(*vector.shape[:-1], 3, 3) @ scalings[0])
    fixed = ((w > 0).sum(-1) >= _MIN_MATCHES) & (values[..., 1] > 1e-10 * values[..., -1].clamp(min=1e-12))
    fixed = fixed & (torch.linalg.det(H).abs() > 1e-12 * H.square().sum((-1, -2)).pow(1.5))
    return H / H.square().sum((-1, -2)).sqrt().clamp(min=1e-300)[..., None, None], fixed


def find_homography(
    pixels: FloatArray,
    *,
    weights: FloatArray | None = None,
    estimator: Literal["magsac", "ransac", "dlt"] = "magsac",
    threshold: float = THRESHOLD,
    seed: int = 0,
) -> HomographyResult:
    """The homography that matches (N, 4) = [u0, v0, u1, v1] agree on; arguments as of `geomoe3d.images.pose`.

    Raises:
        InputError: shapes do not fit, a threshold that is not positive, or an unknown estimator.
    """
    pixels, w = checked(pixels, weights, threshold)
    usable = np.isfinite(pixels).all(axis=1)
    kept = np.flatnonzero(w > 0)
    nothing = HomographyResult("failed", (), None, np.zeros(len(pixels), bool), np.full(len(pixels), np.inf))
    if len(kept) < _MIN_MATCHES:
        reason = f"{len(kept)} matches are kept of {len(pixels)}; at least {_MIN_MATCHES} are needed"
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
    if inliers.sum() < _LEAST_INLIERS:
        reasons.append(f"{inliers.sum()} inliers; below {_LEAST_INLIERS} a wrong homography finds as many")
    elif (
        np.linalg.matrix_rank(pixels[inliers, :2] - pixels[inliers, :2].mean(axis=0), tol=10 * threshold) < 2
    ):
        reasons.append("the inliers lie in line or at one place, and fix the homography nowhere else")
    corners = map_points(
        H, np.array([[x, y] for x in _range(pixels[usable, 0]) for y in _range(pixels[usable, 1])])
    )
    if not np.isfinite(corners).all():
        reasons.append("it sends a part of the first image behind the camera")
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
