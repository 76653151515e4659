"""What a registration returns: the transform, how sure it is, and where it came from.

A result fresh from `register` also remembers what it was made of (`geomoe3d.clouds.inputs`), for pictures.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np

from geomoe3d.clouds.inputs import NOT_KEPT, Inputs
from geomoe3d.errors import InputError
from geomoe3d.runtime.plain import parse_json, plain
from geomoe3d.types import Accuracy, Alternative, BoolArray, CloudReport, FloatArray

if TYPE_CHECKING:
    from geomoe3d.visual.view import RegistrationView

Status = Literal["ok", "low_confidence", "ambiguous", "failed"]


@dataclass(frozen=True, eq=False, repr=False)  # arrays have no single truth value: compare what matters
class RegistrationResult:
    """The answer to "which rigid transform lays source on target?", with its own judgement.

    Attributes:
        T_target_source: (4, 4) float64, p_target = R p_source + t, in the files' own coordinates. Present
            whatever the status, except that a `failed` result without any hypothesis holds NaN: never
            the identity as a stand-in. Where the scale was estimated its linear part is ``scale`` times R.
        status: ok | low_confidence | ambiguous | failed.
        reasons: why the status is not ok, or what deserves attention; sentences.
        confidence: in [0, 1]; see docs/concepts.md for what it is made of.
        overlap: share of source voxel points (1,500 of them at most) with a target point within the inlier
            threshold.
        evidence: what the clouds say of the answer, see `geomoe3d.scoring.surfaces.Evidence` (measured from the
            cloud with more points, whichever the source is; the overlap from the source);
            ``overlap_target``, the share of target voxel points with a source point within the threshold;
            ``margin``, by how much the surface network prefers the answer, where it was asked;
            ``observability`` and ``looseness``, see `geomoe3d.decision.confidence.Information`; ``scale_ratio``,
            lengths of the source over those of the target as the surfaces have them (about 1 / ``scale`` where that was
            estimated), and ``scale_sigma``, see `geomoe3d.decision.scale.Scale`, where enough surface is shared; empty
            where nothing was estimated.
        scale: p_target = scale R p_source + t: lengths of the source times it are those of the target; 1 unless it was
            estimated. Lengths of a result are the target's.
        accuracy: how closely the clouds lie on each other and how far off the transform may be; None where too
            little lies on each other to say, and in results of earlier versions.
        num_correspondences: correspondences given to the estimator.
        num_inliers: of these, how many agree with the transform.
        inlier_threshold: residual limit of an inlier, cloud units.
        voxel_size: edge of the voxel grid, cloud units.
        alternative: the best clearly different transform, or None.
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
    accuracy: Accuracy | None = None
    scale: float = 1.0

    _inputs: ClassVar[Inputs | None] = None  # no field: it is neither compared nor part of the JSON

    @property
    def ok(self) -> bool:
        """True only for status ok."""
        return self.status == "ok"

    @property
    def has_transform(self) -> bool:
        """Whether there is a transform at all, right or not; False where everything failed."""
        return bool(np.isfinite(self.T_target_source).all())

    @property
    def correspondences(self) -> FloatArray:
        """(K, 6) rows [source xyz, target xyz] given to the estimator, in the files' coordinates.

        Raises:
            InputError: the result does not hold them, as one read from JSON.
        """
        if self._inputs is None:
            raise InputError(NOT_KEPT.format(what="its correspondences"))
        return self._inputs.correspondences

    @property
    def inliers(self) -> BoolArray:
        """(K,) True where a correspondence agrees with the transform; all False without one."""
        from geomoe3d.geometry.se3 import residuals

        rows = self.correspondences
        return residuals(self.T_target_source, rows[:, :3], rows[:, 3:]) < self.inlier_threshold

    def apply(self, points: Any) -> Any:
        """Move source points, file coordinates, into the target's file coordinates.

        Args:
            points: (N, 3) array; tensor; Open3D or trimesh cloud or mesh; or `PointCloud`.

        Returns:
            The same kind of object, moved (an array is float64); what was given stays as it is.

        Raises:
            InputError: nothing that holds points (N, 3), or the result holds no transform.
        """
        from geomoe3d.clouds.moved import moved

        return moved(points, self._transform())

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the result in any format of ``geomoe3d register --output``.

        Args:
            path: .json holds the whole result; .txt, .npy, .yaml, .tum and .kitti the transform, and so does a
                name in front of the path: ``pdal:FILE``, ``ros:FILE``, ``quaternion:FILE``, ...
            force: replace an existing file.

        Raises:
            FormatError: no such format.
            InputError: the result holds no transform, and the format asks for one.
            OutputError: the file exists and ``force`` is False, or it cannot be written.
        """
        from geomoe3d.clouds.transform_files import save_result, transform_format

        if transform_format(path)[0] != "json":
            self._transform()
        times = "" if self.scale == 1.0 else f"{self.scale:.9g} "
        comments = [
            f"maps {self.source.name} into {self.target.name}: p_target = {times}R p_source + t",
            f"status {self.status}, confidence {self.confidence:.4f}",
        ]
        save_result(path, self, comments, force=force)

    def save_aligned(
        self,
        path: str | os.PathLike[str],
        source: Any = None,
        *,
        distances: bool = False,
        target: Any = None,
        force: bool = False,
    ) -> tuple[str, ...]:
        """Write the source at full resolution, moved into the target's coordinates (``register --aligned``).

        Args:
            path: any suffix of `geomoe3d.save_points`, or of a mesh where the source is one.
            source: None takes the source that was registered.
            distances: write for each point its distance to the nearest point of the target at full resolution,
                cloud units, as a field ``distance`` (``--distances``).
            target: to which distances are measured; None takes the target that was registered.
            force: replace an existing file.

        Returns:
            What the source says of its points and the format cannot hold, by name.

        Raises:
            InputError: the result holds no transform, or a cloud is neither remembered nor given.
            FormatError, OutputError: as `save`; FormatError too where the format holds no distances.
        """
        from geomoe3d.clouds.saving import save_aligned

        kept = self._inputs or Inputs(None, None)
        data, other = kept.source if source is None else source, kept.target if target is None else target
        for what, cloud in (("source", data), *([("target", other)] if distances else [])):
            if cloud is None:
                raise InputError(NOT_KEPT.format(what=f"the {what}"))
        aside: dict[str, Any] = {"target": other if distances else None, "scale": self.scale}
        return save_aligned(path, data, self._transform(), **aside, force=force)

    def picture(
        self,
        path: str | os.PathLike[str],
        *,
        source: Any = None,
        target: Any = None,
        unit: str = "",
        force: bool = False,
    ) -> None:
        """Draw before, after, correspondences and residuals into one picture (``register --picture``).

        Args:
            path: .png, .pdf, .svg, .jpg or .webp.
            source, target: None takes what was registered, loaded again.
            unit: name of the files' unit of length, such as "m", for the numbers; empty where it is not known.
            force: replace an existing file.

        Raises:
            InputError: a cloud is neither remembered nor given, or has changed since.
            FormatError, OutputError: as `save`.
        """
        from geomoe3d.visual.picture import save_picture

        save_picture(self._view(source, target, unit), path, force=force)

    def page(
        self,
        path: str | os.PathLike[str],
        *,
        source: Any = None,
        target: Any = None,
        unit: str = "",
        force: bool = False,
    ) -> None:
        """Write a page in which the clouds can be turned (``register --page``); arguments as `picture`.

        Raises:
            InputError, OutputError: as `picture`.
        """
        from geomoe3d.visual.page import save_page

        save_page(self._view(source, target, unit), path, force=force)

    def report(
        self,
        path: str | os.PathLike[str],
        *,
        source: Any = None,
        target: Any = None,
        unit: str = "",
        force: bool = False,
    ) -> None:
        """Write one sheet for a customer as PDF (``register --report``); arguments as `picture`.

        Raises:
            InputError, FormatError, OutputError: as `picture`.
        """
        from geomoe3d.visual.sheet import save_sheet

        save_sheet(self._view(source, target, unit), path, force=force)

    def __repr__(self) -> str:
        from geomoe3d.visual.accuracy_facts import paragraph

        return f"<RegistrationResult {paragraph(self)}>"

    def _repr_html_(self) -> str:
        """What a notebook shows: the words, and the clouds to turn where they are still at hand."""
        from geomoe3d.visual.accuracy_facts import paragraph
        from geomoe3d.visual.notebook import notebook_html

        try:
            view = self._view(None, None)
        except (InputError, OSError):
            view = None
        return notebook_html(self.status, paragraph(self), view)

    def _transform(self) -> FloatArray:
        if not self.has_transform:
            raise InputError(
                f"this result holds no transform (status {self.status}: {'; '.join(self.reasons)})"
            )
        return self.T_target_source

    def _view(self, source: Any, target: Any, unit: str = "") -> RegistrationView:
        from geomoe3d.visual.view import RegistrationView

        kept = self._inputs or Inputs(None, None)
        clouds = kept.clouds(source, target, self.seed)
        found = kept.correspondences, kept.weights, kept.groups, kept.group_names
        return RegistrationView.of(self, clouds, *found, unit)

    def _with_inputs(self, inputs: Inputs) -> RegistrationResult:
        """The same result, which knows what it was made of."""
        copy = replace(self)
        object.__setattr__(copy, "_inputs", inputs)
        return copy

    def inverse(self) -> RegistrationResult:
        """The same answer with the roles of source and target exchanged.

        The information matrix is carried over to the new target (the old source): the perturbation is
        expressed in its axes about the same physical point. The overlaps change places, a ratio of scales is
        turned over; the rest of the evidence and the alternative's translation difference keep the meaning measured
        on the original source.
        """
        from geomoe3d.geometry.se3 import inverse, transform_points

        if not self.has_transform:
            return self._exchanged(replace(self, source=self.target, target=self.source))
        T = inverse(self.T_target_source, self.scale)
        # A left perturbation xi of T about c equals the perturbation -Ad(xi) of T^-1 about T^-1 c.
        A = np.zeros((6, 6))
        A[:3, :3], A[3:, 3:] = self.T_target_source[:3, :3] / self.scale, self.T_target_source[:3, :3]
        other = self.alternative
        if other is not None:
            other = replace(other, T_target_source=inverse(other.T_target_source, self.scale))
        evidence, overlap = dict(self.evidence), self.overlap
        if "overlap_target" in evidence:
            overlap = evidence["overlap_target"]
            evidence |= {"overlap": overlap, "overlap_target": self.overlap}
        if "scale_ratio" in evidence:
            evidence["scale_ratio"] = 1 / evidence["scale_ratio"]
        answer = replace(
            self,
            T_target_source=T,
            overlap=overlap,
            evidence=evidence,
            alternative=other,
            information_matrix=A.T @ self.information_matrix @ A,
            information_center=transform_points(T, self.information_center[None])[0],
            accuracy=None if self.accuracy is None else self.accuracy.exchanged(self.scale),
            scale=1 / self.scale,
            inlier_threshold=self.inlier_threshold / self.scale,
            voxel_size=self.voxel_size / self.scale,
            source=self.target,
            target=self.source,
        )
        return self._exchanged(answer)

    def _exchanged(self, other: RegistrationResult) -> RegistrationResult:
        return other if self._inputs is None else other._with_inputs(self._inputs.exchanged())

    def to_json(self, indent: int | None = 2) -> str:
        """JSON text; floats keep every bit, missing numbers are null."""
        return json.dumps(plain(self), indent=indent, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> RegistrationResult:
        """Inverse of `to_json`.

        Raises:
            InputError: the text is no registration result.
        """
        try:
            data = parse_json(text)
            data["T_target_source"] = _array(data["T_target_source"], (4, 4))
            data["information_matrix"] = _array(data["information_matrix"], (6, 6))
            data["information_center"] = _array(data["information_center"], (3,))
            data |= _numbers({name: data[name] for name in ("inlier_threshold", "voxel_size", "overlap")})
            if data["alternative"] is not None:
                T = _array(data["alternative"].pop("T_target_source"), (4, 4))
                data["alternative"] = Alternative(T, **_numbers(data["alternative"]))
            for side in ("source", "target"):
                data[side]["origin"] = tuple(data[side]["origin"])
                data[side] = CloudReport(**data[side])
            data["reasons"] = tuple(data["reasons"])
            if data.get("accuracy") is not None:
                data["accuracy"] = Accuracy(**_numbers(data["accuracy"]))
            found = cls(**data)
            _check_consistent(found)
            return found
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"this text is not a registration result: {error!r}") from None


def _check_consistent(result: RegistrationResult) -> None:
    """Raises ValueError: a result as nothing here writes it, changed by hand or damaged."""
    if result.status not in get_args(Status):
        raise ValueError(f"status '{result.status}' is none of {', '.join(get_args(Status))}")
    if not 0 <= result.confidence <= 1:
        raise ValueError(f"confidence {result.confidence} is not in [0, 1]")
    T = result.T_target_source
    if result.status == "failed" and np.isnan(T).all():
        return
    R = T[:3, :3] / result.scale
    rigid = np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=0.01) and np.linalg.det(R) > 0
    if not rigid or not np.array_equal(T[3], [0, 0, 0, 1]):
        raise ValueError("T_target_source is no rotation and translation (times scale)")


def _numbers(values: dict[str, Any]) -> dict[str, float]:
    return {name: float("nan") if value is None else float(value) for name, value in values.items()}


def _array(value: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.array(value, dtype=np.float64)  # None becomes NaN
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape} where {shape} is expected")
    return array
