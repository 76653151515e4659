"""What a registration returns: the transform, how sure it is, and where it came from."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.errors import InputError
from geomoe3d.types import FloatArray

Status = Literal["ok", "low_confidence", "ambiguous", "failed"]

_ARRAYS = {"T_target_source": (4, 4), "information_matrix": (6, 6), "information_center": (3,)}


@dataclass(frozen=True)
class CloudReport:
    """What became of one input cloud.

    Attributes:
        name: file name or a given label.
        num_input: points given.
        num_non_finite: dropped for a NaN or infinite coordinate.
        num_duplicates: dropped because another point has exactly the same coordinates.
        num_isolated: voxels dropped because no neighbour is close enough to fit a normal.
        num_points: voxel points used.
        origin: float64 shift removed from the file's coordinates before computing.
    """

    name: str
    num_input: int
    num_non_finite: int
    num_duplicates: int
    num_isolated: int
    num_points: int
    origin: tuple[float, float, float]


@dataclass(frozen=True)
class Alternative:
    """The best hypothesis that is clearly another motion than the answer.

    Attributes:
        T_target_source: (4, 4) in file coordinates.
        relative_score: its verification score over that of the answer, 1 means as good.
        rotation_difference_deg: angle between the two rotations.
        translation_difference: distance between the two images of the source centroid, cloud units.
    """

    T_target_source: FloatArray
    relative_score: float
    rotation_difference_deg: float
    translation_difference: float


@dataclass(frozen=True, eq=False)  # arrays have no single truth value: compare what matters
class RegistrationResult:
    """The answer to "which rigid motion lays source on target?", with its own judgement.

    Attributes:
        T_target_source: (4, 4) float64, p_target = R p_source + t, in the files' own coordinates. Present
            whatever the status, except that a `failed` result without any hypothesis holds NaN: never
            the identity as a stand-in.
        status: ok | low_confidence | ambiguous | failed.
        reasons: why the status is not ok, or what deserves attention; sentences.
        confidence: in [0, 1]; see docs/concepts.md for what it is made of.
        overlap: share of source voxel points (1,500 of them at most) with a target point within the inlier
            threshold.
        evidence: what the clouds say of the answer, see `geomoe3d.scoring.surfaces.Evidence`, and
            ``observability`` and ``looseness``, see `geomoe3d.decision.confidence.Information`; empty where
            nothing was estimated.
        num_correspondences: correspondences given to the estimator.
        num_inliers: of these, how many agree with the transform.
        inlier_threshold: residual limit of an inlier, cloud units.
        voxel_size: edge of the voxel grid, cloud units.
        alternative: the best clearly different motion, or None.
        information_matrix: (6, 6), order [rotation (rad), translation], for the left perturbation
            p_target -> exp(rotation) (p_target - c) + c + translation in the target file's axes, with
            c = ``information_center``; over the point-to-plane residual variance of the matched points.
            NaN where nothing was estimated.
        information_center: (3,) the point c, target file coordinates.
        source, target: what became of each cloud.
        seconds: wall time of each stage and ``total``.
        seed: the seed used.
        versions: geomoe3d and the libraries that decide numbers.
        config: the complete configuration as nested mapping.
    """

    T_target_source: FloatArray
    status: Status
    reasons: tuple[str, ...]
    confidence: float
    overlap: float
    evidence: dict[str, float]
    num_correspondences: int
    num_inliers: int
    inlier_threshold: float
    voxel_size: float
    alternative: Alternative | None
    information_matrix: FloatArray
    information_center: FloatArray
    source: CloudReport
    target: CloudReport
    seconds: dict[str, float] = field(default_factory=dict)
    seed: int = 0
    versions: dict[str, str] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """True only for status ok."""
        return self.status == "ok"

    def apply(self, points: ArrayLike) -> FloatArray:
        """Move source points (N, 3), file coordinates, into the target's file coordinates.

        Raises:
            InputError: the array is not (N, 3), or the result holds no transform.
        """
        from geomoe3d.geometry.se3 import transform_points

        if not np.isfinite(self.T_target_source).all():
            raise InputError(
                f"this result holds no transform (status {self.status}: {'; '.join(self.reasons)})"
            )
        try:
            array = np.asarray(points, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(
                f"points must be numbers of shape (N, 3), found a {type(points).__name__}; "
                "geomoe3d.load_points(...).file_points gives those of a file or an object"
            ) from None
        if array.ndim != 2 or array.shape[1] != 3:
            raise InputError(f"points must have shape (N, 3), found {array.shape}")
        return transform_points(self.T_target_source, array)

    def inverse(self) -> RegistrationResult:
        """The same answer with the roles of source and target exchanged.

        The information matrix is carried over to the new target (the old source): the perturbation is
        expressed in its axes about the same physical point. Overlap, evidence and the alternative's
        translation difference keep the meaning measured on the original source.
        """
        from geomoe3d.geometry.se3 import inverse, transform_points

        if not np.isfinite(self.T_target_source).all():
            return replace(self, source=self.target, target=self.source)
        T = inverse(self.T_target_source)
        # A left perturbation xi of T about c equals the perturbation -Ad(xi) of T^-1 about T^-1 c.
        A = np.zeros((6, 6))
        A[:3, :3] = A[3:, 3:] = self.T_target_source[:3, :3]
        other = self.alternative
        if other is not None:
            other = replace(other, T_target_source=inverse(other.T_target_source))
        return replace(
            self,
            T_target_source=T,
            alternative=other,
            information_matrix=A.T @ self.information_matrix @ A,
            information_center=transform_points(T, self.information_center[None])[0],
            source=self.target,
            target=self.source,
        )

    def to_json(self, indent: int | None = 2) -> str:
        """JSON text; floats keep every bit, missing numbers are null."""
        return json.dumps(_plain(asdict(self)), indent=indent, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> RegistrationResult:
        """Inverse of `to_json`.

        Raises:
            InputError: the text is no registration result.
        """
        try:
            data = json.loads(text)
            for name, shape in _ARRAYS.items():
                data[name] = _array(data[name], shape)
            for name in ("inlier_threshold", "voxel_size"):
                data[name] = float("nan") if data[name] is None else float(data[name])
            if data["alternative"] is not None:
                data["alternative"]["T_target_source"] = _array(
                    data["alternative"]["T_target_source"], (4, 4)
                )
                data["alternative"] = Alternative(**data["alternative"])
            for side in ("source", "target"):
                data[side]["origin"] = tuple(data[side]["origin"])
                data[side] = CloudReport(**data[side])
            data["reasons"] = tuple(data["reasons"])
            return cls(**data)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"this text is not a registration result: {error!r}") from None


def _plain(value: Any) -> Any:
    """Arrays to lists and non-finite numbers to None, since JSON has neither."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _array(value: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.array(value, dtype=np.float64)  # None becomes NaN
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape} where {shape} is expected")
    return array
