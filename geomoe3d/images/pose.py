"""From matches of two images to the relative pose, with a word on how sure it is.

Of the poses that an essential matrix allows, the one with the points before both cameras is taken. What two images
cannot tell is looked for afterwards: a translation where the cameras only turned or hardly moved, a single pose where
all inliers lie in one plane, agreement that chance would give as well, and whether half of the matches agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from geomoe3d.errors import InputError
from geomoe3d.geometry.essential import (
    MIN_MATCHES,
    decompose,
    depths,
    essential_of,
    pose_errors_deg,
    symmetric_distance,
    weighted_eight_point,
)
from geomoe3d.geometry.se3 import make_transform, project_to_so3, rotation_error_deg
from geomoe3d.images.cameras import Camera, opencv, rays_of, robust_estimator
from geomoe3d.images.config import POSE
from geomoe3d.images.features import checked, halves_of, random_halves
from geomoe3d.types import BoolArray, FloatArray, IntArray

Estimator = Literal["magsac", "ransac", "eight_point"]


@dataclass(frozen=True)
class PoseResult:
    """The answer for two images.

    Attributes:
        status: ``ok``; ``ambiguous``: more than one pose fits, or the translation is not fixed;
            ``low_confidence``: it may be wrong; ``failed``: there is none.
        reasons: why it is not ok, sentences.
        R: (3, 3), X1 = R X0 + t in the cameras' frames (x right, y down, z forward); None where failed.
        t: (3,) of unit length: two images do not tell how far the camera moved; None where failed.
        inliers: (N,) bool, matches within the threshold of their epipolar lines, before both cameras.
        residuals: (N,) root of the mean squared distance to both epipolar lines, pixels; inf where failed.
        parallax: median distance in pixels by which inliers moved beyond the best rotation alone.
        alternatives: other poses (4, 4) that fit as well, for a planar scene.
    """

    status: Literal["ok", "low_confidence", "ambiguous", "failed"]
    reasons: tuple[str, ...]
    R: FloatArray | None
    t: FloatArray | None
    inliers: BoolArray
    residuals: FloatArray
    parallax: float = 0.0
    alternatives: tuple[FloatArray, ...] = ()

    @property
    def T(self) -> FloatArray | None:
        """(4, 4) of R and t, or None where failed."""
        return None if self.R is None or self.t is None else make_transform(self.R, self.t)


def find_pose(
    pixels: FloatArray,
    cameras: tuple[Camera, Camera],
    *,
    weights: FloatArray | None = None,
    estimator: Estimator = "magsac",
    threshold: float | None = None,
    seed: int = 0,
) -> PoseResult:
    """The pose of the second camera from matches.

    Args:
        pixels: (N, 4) rows [u0, v0, u1, v1]; rows that are not finite are never inliers.
        cameras: of both images.
        weights: (N,) in [0, 1] from a network; those above 0 are kept. None keeps all alike.
        estimator: ``eight_point`` uses the weights themselves, the others which are kept.
        threshold: inlier threshold in pixels; None: 1/800 of the image's longer side.
        seed: of the random samples.

    Raises:
        InputError: shapes do not fit, a threshold that is not positive, or an unknown estimator.
    """
    pixels, w = checked(pixels, weights, threshold, seed)
    if not (isinstance(cameras, Sequence) and len(cameras) == 2):
        raise InputError("two cameras are needed, (of the first image, of the second image)")
    focal = (cameras[0].focal + cameras[1].focal) / 2
    if threshold is None:
        halves = halves_of(pixels[np.isfinite(pixels).all(axis=1)])
        threshold = POSE.pixel_share * focal * max(c.side(x) for c, x in zip(cameras, halves, strict=True))
    rays = rays_of(pixels, cameras)

    def pose_of(rows: IntArray) -> FloatArray | None:
        enough = len(rows) >= MIN_MATCHES
        return _estimate(rays[rows], w[rows], estimator, threshold / focal, seed) if enough else None

    kept = np.flatnonzero(w > 0)
    T = pose_of(kept)
    if T is None:
        reason = "no essential matrix fits: the matches fix none, as where all lie on a line"
        if len(kept) < MIN_MATCHES:
            reason = f"{len(kept)} matches are kept of {len(pixels)}; at least {MIN_MATCHES} are needed"
        none = np.zeros(len(pixels), dtype=bool)
        return PoseResult("failed", (reason,), None, None, none, np.full(len(pixels), np.inf))
    residuals = np.nan_to_num(residuals_of(T, rays) * focal, nan=np.inf)
    inliers = (w > 0) & _agrees(T, rays, threshold / focal)
    result = _judged(T, rays, inliers, residuals, kept, threshold / focal, focal, pose_of)
    if estimator == "eight_point" and inliers.sum() < POSE.least_agreeing * len(kept):
        few = f"{inliers.sum()} of {len(kept)} kept matches agree, and eight_point rejects none; try magsac or ransac"
        return replace(result, status="low_confidence", reasons=(*result.reasons, few))
    return result


def residuals_of(T: FloatArray, rays: FloatArray) -> FloatArray:
    """(N,) root of the mean squared distance to both epipolar lines, focal lengths."""
    square = symmetric_distance(essential_of(torch.from_numpy(T)), torch.from_numpy(rays))
    return np.sqrt(square.numpy() / 2)


def _agrees(T: FloatArray, rays: FloatArray, threshold: float) -> BoolArray:
    """(N,) whether a match lies before both cameras and within the threshold of its epipolar lines."""
    z0, z1 = depths(torch.from_numpy(T), torch.from_numpy(rays))
    return ((z0 > 0) & (z1 > 0)).numpy() & (residuals_of(T, rays) < threshold)


def _estimate(
    rays: FloatArray, w: FloatArray, estimator: str, threshold: float, seed: int
) -> FloatArray | None:
    x, weights = torch.from_numpy(rays)[None], torch.from_numpy(w)[None]
    if estimator == "eight_point":
        fit = weighted_eight_point(x, weights)
        return decompose(fit.E, x, weights)[0].numpy() if bool(fit.valid[0]) else None
    cv2, method = robust_estimator(estimator, seed, "eight_point")
    given = {"prob": POSE.sureness, "threshold": threshold, "maxIters": POSE.most_samples}
    try:
        found, _ = cv2.findEssentialMat(*halves_of(rays), np.eye(3), method=method, **given)
    except cv2.error:  # raised where no sample gives a matrix
        return None
    if found is None or len(found) < 3 or not np.isfinite(found).all():
        return None
    # Five points alone may leave several matrices; the one that most matches agree with is meant.
    several = torch.from_numpy(found).reshape(-1, 3, 3)
    poses = decompose(several, x.expand(len(several), -1, -1), weights.expand(len(several), -1)).numpy()
    best: FloatArray = max(poses, key=lambda T: int(_agrees(T, rays, threshold).sum()))
    return best


def _judged(
    T: FloatArray, rays: FloatArray, inliers: BoolArray, residuals: FloatArray, kept: IntArray, threshold: float,
    focal: float, pose_of: Callable[[IntArray], FloatArray | None],
) -> PoseResult:  # fmt: skip
    """What the inliers say of the pose."""
    found = int(inliers.sum())
    reasons, ambiguous, parallax = [], False, 0.0
    alternatives: tuple[FloatArray, ...] = ()
    if found < POSE.least_inliers:
        reasons.append(f"{found} inliers; below {POSE.least_inliers} a wrong pose finds as many")
    if found >= MIN_MATCHES:
        rng, (first, second), rounds = np.random.default_rng(0), halves_of(rays[kept]), 20
        shuffled = np.concatenate([np.hstack([first, rng.permutation(second)]) for _ in range(rounds)])
        chance = _agrees(T, shuffled, threshold).sum() / rounds
        if found < POSE.over_chance * chance + POSE.least_inliers:
            reasons.append(
                f"{found} inliers, where matches shuffled at random have {chance:.0f} under this pose"
            )
        x = rays[inliers]
        parallax = _beyond_rotation(x)
        if parallax < POSE.least_parallax * threshold:
            ambiguous = True
            reasons.append(
                f"the inliers move by {parallax * focal:.1f} pixels beyond a rotation: the camera only turned, or its "
                "way is short beside the distance of the scene; R holds, t does not"
            )
        elif alternatives := _of_a_plane(T, x, threshold):
            ambiguous = True
            reasons.append("nearly all inliers lie in one plane, and a second pose explains them as well")
        elif (off := _between_halves(T, kept, pose_of)) > POSE.most_between_halves_deg:
            reasons.append(
                f"half of the matches alone give a pose that is off by {off:.0f} degrees; "
                f"{POSE.most_between_halves_deg:.0f} are allowed"
            )
    status: Literal["ok", "low_confidence", "ambiguous"] = "low_confidence" if reasons else "ok"
    if ambiguous and len(reasons) == 1:
        status = "ambiguous"
    return PoseResult(
        status, tuple(reasons), T[:3, :3], T[:3, 3], inliers, residuals, parallax * focal, alternatives
    )


def _between_halves(T: FloatArray, kept: IntArray, pose_of: Callable[[IntArray], FloatArray | None]) -> float:
    """Largest angle in degrees, of rotation or translation, between T and the poses of either half of the matches."""
    truth, worst = torch.from_numpy(T), 0.0
    for other in map(pose_of, random_halves(kept)):
        if other is None:
            return 180.0
        worst = max(worst, *map(float, pose_errors_deg(torch.from_numpy(other), truth)))
    return worst


def _beyond_rotation(x: FloatArray) -> float:
    """Median distance of second rays (N, 4) from the first under the rotation that best lays these on them."""
    first, second = (np.column_stack([half, np.ones(len(x))]) for half in halves_of(x))
    first, second = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (first, second))
    weights = np.ones(len(x))
    for _ in range(5):  # far points decide: those that the rotation alone explains
        moved = first @ project_to_so3((second * weights[:, None]).T @ first).T
        weights = 1 / (1e-4 + np.linalg.norm(moved - second, axis=1))
    return float(np.median(np.linalg.norm(moved[:, :2] / np.maximum(moved[:, 2:], 1e-9) - x[:, 2:], axis=1)))


def _of_a_plane(T: FloatArray, x: FloatArray, threshold: float) -> tuple[FloatArray, ...]:
    """Poses other than T that the homography of inliers (N, 4) allows and that explain nearly all of them."""
    cv2 = opencv()
    H, _ = cv2.findHomography(*halves_of(x), cv2.RANSAC, threshold)
    if H is None:
        return ()
    _, turns, steps, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    others = []
    for R, t in zip(turns, steps, strict=True):
        other = make_transform(R, t[:, 0] / max(np.linalg.norm(t), 1e-12))
        explained = _agrees(other, x, threshold).mean() > POSE.explained
        if explained and rotation_error_deg(other, T) > POSE.other_pose_deg:
            others.append(other)
    return tuple(others)
