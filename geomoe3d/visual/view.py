"""What every display of a registration is made from: the clouds, the answer and the correspondences.

`RegistrationView` holds data in the files' own coordinates and checks that its parts fit together. It
draws nothing itself: `picture`, `page` and `window` take it, and share what `drawing` derives from it.
Cost: one pass over the correspondences for their residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import residuals
from geomoe3d.types import BoolArray, FloatArray, IntArray, PointCloud

if TYPE_CHECKING:
    from geomoe3d.result import RegistrationResult
    from geomoe3d.types import Alternative

WEIGHT_THRESHOLD = 0.5


@dataclass(frozen=True)
class RegistrationView:
    """One registration, ready to be shown. All coordinates are those of the files.

    Attributes:
        source_points: (N, 3) float64, not moved.
        target_points: (M, 3) float64.
        result: the answer that is shown. A transform of NaN is allowed: only "before" is drawn then.
        correspondences: (K, 6) rows [source xyz, target xyz]; K may be 0.
        weights: (K,) in [0, 1] as a filter gave them, or None where no filter ran.
        source_colors: (N, 3) in [0, 1] or None.
        target_colors: (M, 3) in [0, 1] or None.
        groups: (K,) non-negative group of each correspondence, or None. When given, correspondences are
            coloured by group instead of inlier or outlier.
        group_names: name of group 0, 1, ...; groups beyond it are called by their number.
        weight_threshold: a correspondence counts as kept where its weight is larger than this.
        unit: name of the files' unit of length, such as "m"; empty where it is not known.

    Raises:
        InputError: shapes that do not fit together, or values outside their range.
    """

    source_points: FloatArray
    target_points: FloatArray
    result: RegistrationResult
    correspondences: FloatArray
    weights: FloatArray | None = None
    source_colors: FloatArray | None = None
    target_colors: FloatArray | None = None
    groups: IntArray | None = None
    group_names: tuple[str, ...] = ()
    weight_threshold: float = WEIGHT_THRESHOLD
    unit: str = ""

    @classmethod
    def of(
        cls,
        result: RegistrationResult,
        clouds: tuple[PointCloud, PointCloud],
        correspondences: FloatArray,
        weights: FloatArray | None = None,
        groups: IntArray | None = None,
        group_names: tuple[str, ...] = (),
        unit: str = "",
    ) -> RegistrationView:
        """From the clouds as loaded, source and target; groups only where more than one of them agrees."""
        if groups is not None and (weights is None or len(np.unique(groups[weights > WEIGHT_THRESHOLD])) < 2):
            groups = None  # one colour for all would hide what agrees
        source, target = clouds
        return cls(
            source.file_points,
            target.file_points,
            result,
            correspondences,
            weights=weights,
            source_colors=source.colors,
            target_colors=target.colors,
            groups=groups,
            group_names=group_names,
            unit=unit,
        )

    def __post_init__(self) -> None:
        _check_shape("source_points", self.source_points, (None, 3))
        _check_shape("target_points", self.target_points, (None, 3))
        _check_shape("correspondences", self.correspondences, (None, 6))
        num = len(self.correspondences)
        if self.weights is not None:
            _check_shape("weights", self.weights, (num,))
            _check_range("weights", self.weights)
        if self.source_colors is not None:
            _check_shape("source_colors", self.source_colors, (len(self.source_points), 3))
            _check_range("source_colors", self.source_colors)
        if self.target_colors is not None:
            _check_shape("target_colors", self.target_colors, (len(self.target_points), 3))
            _check_range("target_colors", self.target_colors)
        if self.groups is not None:
            _check_shape("groups", self.groups, (num,))
            if not np.issubdtype(self.groups.dtype, np.integer) or (num and self.groups.min() < 0):
                raise InputError("groups must be integers that are not negative")

    @property
    def has_transform(self) -> bool:
        """False where the registration failed without any hypothesis (the transform holds NaN)."""
        return bool(np.isfinite(self.result.T_target_source).all())

    @property
    def rival(self) -> Alternative | None:
        """The alternative where it matters: the answer is ambiguous, or it does a third as well or better."""
        other = self.result.alternative
        if other is None or not np.isfinite(other.T_target_source).all():
            return None
        # One that scores a third of the answer matters.
        return other if self.result.status == "ambiguous" or other.relative_score >= 1 / 3 else None

    def residuals(self) -> FloatArray:
        """(K,) distance of each moved source point to its target point, cloud units; NaN if no transform."""
        if not self.has_transform:
            return np.full(len(self.correspondences), np.nan)
        rows = self.correspondences
        return residuals(self.result.T_target_source, rows[:, :3], rows[:, 3:])

    def kept(self) -> BoolArray:
        """(K,) True where a correspondence agrees with the transform: the inliers of the answer.

        Without a transform, where the filter keeps it; all False where there is neither.
        """
        if self.has_transform or self.weights is None:
            return np.asarray(self.residuals() < self.result.inlier_threshold)  # NaN compares as False
        return np.asarray(self.weights > self.weight_threshold)

    @property
    def kept_words(self) -> tuple[str, str]:
        """What the two sides of `kept` are called in a legend."""
        if self.has_transform:
            return "inliers of the answer", "outliers"
        if self.weights is not None:
            return "kept by the filter", "rejected by the filter"
        return "kept", "not judged (no transform)"

    def group_label(self, group: int) -> str:
        """The name of a group, or its number where it has none."""
        return self.group_names[group] if group < len(self.group_names) else f"group {group}"


def _check_shape(name: str, array: object, shape: tuple[int | None, ...]) -> None:
    found = getattr(array, "shape", None)
    fits = (
        isinstance(array, np.ndarray)
        and array.ndim == len(shape)
        and all(want is None or want == have for want, have in zip(shape, array.shape, strict=True))
    )
    if not fits:
        wanted = (
            "(" + ", ".join("N" if n is None else str(n) for n in shape) + ("," * (len(shape) == 1)) + ")"
        )
        raise InputError(f"{name} must be an array of shape {wanted}, found {found or type(array).__name__}")


def _check_range(name: str, array: FloatArray) -> None:
    if array.size and not (np.nanmin(array) >= 0.0 and np.nanmax(array) <= 1.0):
        found = f"{np.nanmin(array):.3g} to {np.nanmax(array):.3g}"
        raise InputError(f"{name} must lie in [0, 1], found {found}; scale them first")
