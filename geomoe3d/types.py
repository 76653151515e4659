"""The few nouns that travel through the package: clouds, correspondences, weights, transforms, parts of a result.

All of them are frozen; arrays inside are float64 unless said otherwise and are to be treated as read-only.
Frames: a *file* coordinate is what the user's data holds; a *local* coordinate is the file coordinate minus
the cloud's float64 ``origin``. Everything between loading and the result works in local coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class PointCloud:
    """Finite points of one scan, recentred.

    Attributes:
        points: (N, 3) local coordinates; file coordinate = points + origin.
        origin: (3,) float64 shift removed at load, whole units, zero for clouds close to zero.
        normals: (N, 3) unit normals or None.
        colors: (N, 3) in [0, 1] or None.
        name: what to call the cloud in messages.
        num_non_finite: rows dropped because a coordinate was NaN or infinite, or stands for a missing measurement.
        notes: sentences on what of the file was not taken as it stands.
        sensor: (3,) where the file says that its one sensor stood, file coordinates, or None.
        sensor_given: True where the user said so: ``sensor`` is then believed wherever it lies, and None means that no
            one sensor saw the cloud.
    """

    points: FloatArray
    origin: FloatArray = field(default_factory=lambda: np.zeros(3))
    normals: FloatArray | None = None
    colors: FloatArray | None = None
    name: str = "cloud"
    num_non_finite: int = 0
    notes: tuple[str, ...] = ()
    sensor: FloatArray | None = None
    sensor_given: bool = False

    def __len__(self) -> int:
        return len(self.points)

    @property
    def file_points(self) -> FloatArray:
        """(N, 3) points in the coordinates of the user's data."""
        return self.points + self.origin


@dataclass(frozen=True)
class PreparedCloud:
    """A cloud on a voxel grid with oriented normals and, once described, FPFH features.

    Attributes:
        points: (n, 3) one representative per occupied voxel, local coordinates.
        normals: (n, 3) unit normals turned towards ``viewpoint``, else to the centroid.
        features: (n, D) float32 of length 1, of a descriptor, or None before it was asked.
        voxel_size: edge of the grid in cloud units.
        viewpoint: (3,) local position of the sensor, known or guessed, or None.
        scanned: False for a part of a map: its viewpoint is then no sensor's but the place from which it is looked at,
            and says nothing of what must be empty.
        origin: (3,) float64 shift as in `PointCloud`.
        name: what to call the cloud in messages.
        num_input: points given, before anything was dropped.
        num_non_finite: points dropped for a NaN or infinite coordinate.
        num_duplicates: points dropped because another has exactly the same coordinates.
        num_isolated: voxels dropped because no neighbour lies close enough to fit a normal.
    """

    points: FloatArray
    normals: FloatArray
    features: Float32Array | None
    voxel_size: float
    viewpoint: FloatArray | None
    origin: FloatArray
    name: str = "cloud"
    num_input: int = 0
    num_non_finite: int = 0
    num_duplicates: int = 0
    num_isolated: int = 0
    scanned: bool = True

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def tree(self) -> Any:
        """scipy's k-d tree of the points, made when it is first asked for and shared by all who ask after."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)

    @cached_property
    def center(self) -> FloatArray:
        """(3,) mean of the points: where shifts of transforms are measured, some hundred times for a doubtful pair."""
        middle: FloatArray = self.points.mean(0)
        return middle


@dataclass(frozen=True)
class Correspondences:
    """Putative correspondences between two prepared clouds, or anybody's own.

    Attributes:
        points: (N, 6) rows [source xyz, target xyz], each half in its own cloud's local coordinates.
        source_index: (N,) rows of the source cloud, or None for foreign correspondences.
        target_index: (N,) rows of the target cloud, or None.
        feature_distance: (N,) float32 Euclidean distance of the unit features in [0, 2], or None.
        ratio: (N,) float32 feature distance over that of the second best target, in [0, 1], or None.
        mutual: (N,) True where the source point is also the target's nearest in feature space, or None.
        viewpoints: (3,) places of the source's and the target's sensor, each in its own cloud's local
            coordinates, or None for both where they are not known.
        normals: (N, 3) unit normals at the source and at the target points, each in its own cloud's local
            coordinates, or None for both.
        normals_signed: True where both clouds' normals are turned to a known or guessed sensor: signs count.
    """

    points: FloatArray
    source_index: IntArray | None = None
    target_index: IntArray | None = None
    feature_distance: Float32Array | None = None
    ratio: Float32Array | None = None
    mutual: BoolArray | None = None
    viewpoints: tuple[FloatArray, FloatArray] | None = None
    normals: tuple[FloatArray, FloatArray] | None = None
    normals_signed: bool = False

    def __len__(self) -> int:
        return len(self.points)

    @property
    def source(self) -> FloatArray:
        """(N, 3) source points."""
        return self.points[:, :3]

    @property
    def target(self) -> FloatArray:
        """(N, 3) target points."""
        return self.points[:, 3:]

    @classmethod
    def between(
        cls, source: PreparedCloud, target: PreparedCloud, rows: IntArray, columns: IntArray
    ) -> Correspondences:
        """Source points ``rows`` (N,) matched with target points ``columns`` (N,), with their normals."""
        return cls(
            np.hstack([source.points[rows], target.points[columns]]),
            rows,
            columns,
            normals=(source.normals[rows], target.normals[columns]),
            normals_signed=source.viewpoint is not None and target.viewpoint is not None,
        )

    def exchanged(self) -> Correspondences:
        """The same from the target to the source."""
        return replace(
            self,
            points=np.roll(self.points, 3, axis=1),
            source_index=self.target_index,
            target_index=self.source_index,
            viewpoints=None if self.viewpoints is None else (self.viewpoints[1], self.viewpoints[0]),
            normals=None if self.normals is None else (self.normals[1], self.normals[0]),
        )

    def take(self, rows: IntArray | BoolArray) -> Correspondences:
        """The correspondences of the given rows (index or mask), all per-row attributes kept."""

        def pick(values: NDArray[np.generic] | None) -> NDArray[np.generic] | None:
            return None if values is None else values[rows]

        return Correspondences(
            self.points[rows],
            pick(self.source_index),  # type: ignore[arg-type]
            pick(self.target_index),  # type: ignore[arg-type]
            pick(self.feature_distance),  # type: ignore[arg-type]
            pick(self.ratio),  # type: ignore[arg-type]
            pick(self.mutual),  # type: ignore[arg-type]
            self.viewpoints,
            None if self.normals is None else (self.normals[0][rows], self.normals[1][rows]),
            self.normals_signed,
        )

    def with_others(self, others: Correspondences) -> Correspondences:
        """These and, after them, those of the same clouds that pair other points; what either lacks both lack."""
        known = {row.tobytes() for row in self.points}
        more = others.take(np.array([row.tobytes() not in known for row in others.points], dtype=np.bool_))

        def both(name: str) -> Any:
            parts = getattr(self, name), getattr(more, name)
            return None if parts[0] is None or parts[1] is None else np.concatenate(parts)

        rows = ("points", "source_index", "target_index", "feature_distance", "ratio", "mutual")
        normals = None
        if self.normals is not None and more.normals is not None:
            one, other = (np.concatenate(sides) for sides in zip(self.normals, more.normals, strict=True))
            normals = one, other
        signed = self.normals_signed and more.normals_signed
        return replace(self, **{name: both(name) for name in rows}, normals=normals, normals_signed=signed)


class Score(Protocol):
    """What one scorer says of one hypothesis."""

    @property
    def factor(self) -> float:
        """Not negative; the score of a hypothesis is the product of what its scorers say."""
        ...


@dataclass(eq=False)
class Hypothesis:
    """One candidate transform and all that becomes known of it, from the proposal to the answer.

    Attributes:
        T_target_source: (4, 4), p_target = R p_source + t in local coordinates.
        proposal_score: the estimator's own; larger is better, comparable only within one call of it.
        num_inliers: correspondences with a residual under the inlier threshold.
        scores: what each scorer says of it, by the scorer's name; of one that is asked about the best alone,
            what is assumed of the others.
        asked: names of the scorers that were really asked about it.
        refined: the same hypothesis after refinement, once it was refined; itself an hypothesis.
        is_refined: whether it came out of a refinement and needs no other.
        note: what went wrong in the refinement that led to it, or None.
        settled: whether its estimator saw so many correspondences agree with it, and so many more than with any
            different transform, that it needs no costly scorer.
    """

    T_target_source: FloatArray
    proposal_score: float = 0.0
    num_inliers: int = 0
    scores: dict[str, Score] = field(default_factory=dict)
    asked: set[str] = field(default_factory=set)
    refined: Hypothesis | None = None
    is_refined: bool = False
    note: str | None = None
    settled: bool = False

    def anew(self) -> Hypothesis:
        """The same transform as it was proposed, to be scored by others."""
        return Hypothesis(self.T_target_source, self.proposal_score, self.num_inliers)

    @property
    def score(self) -> float:
        """Product of the factors of all scorers; 1 where none was asked."""
        product = 1.0
        for said in self.scores.values():
            product *= said.factor
        return product

    def exchanged(self) -> Hypothesis:
        """The same from the target to the source; what was said of it stays."""
        R, t = self.T_target_source[:3, :3], self.T_target_source[:3, 3]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ t
        refined = None if self.refined is None else self.refined.exchanged()
        return replace(self, T_target_source=T, refined=refined)


@dataclass(frozen=True)
class FilterOutput:
    """What a filter says of N correspondences.

    Attributes:
        weights: (N,) in [0, 1]; 0 takes a correspondence out of the estimate.
        logits: (N,) raw scores, larger is likelier an inlier, or None.
        groups: (N,) small integers, which part of the filter handled each correspondence, or None.
        group_names: a name for each group, for display.
    """

    weights: FloatArray
    logits: FloatArray | None = None
    groups: IntArray | None = None
    group_names: tuple[str, ...] = ()


@dataclass(frozen=True)
class CloudReport:
    """What became of one input cloud.

    Attributes:
        name: file name or a given label.
        num_input: points given.
        num_non_finite: dropped for a NaN or infinite coordinate, or as missing at exactly (0, 0, 0).
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
    """The best hypothesis that is clearly another transform than the answer.

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


@dataclass(frozen=True)
class Accuracy:
    """How closely the clouds lie on each other, and how far off the transform may be. Lengths in cloud units.

    Distances are those of the grid points of either cloud that have a point of the other within the inlier
    threshold and facing as they do, to the plane of the nearest one, unsigned. Deviations are one standard
    deviation, of a vector's length where it has three components: of right answers, about two in three true errors
    are smaller and 95 in 100 smaller than twice that (docs/measurements.md). Of a wrong answer they say nothing.

    Attributes:
        inlier_rmse: root mean square residual of the correspondences that agree with the transform: how rough matches
            of single points are, and no accuracy of the transform.
        overlap_source: share of source points with a target point within the inlier threshold.
        overlap_target: share of target points with a source point within the inlier threshold.
        distance_mean, distance_median, distance_std, distance_p95: mean, median, standard deviation and 95 %
            quantile of the distances.
        sigma_center: deviation of where the transform puts the centre of the overlap.
        sigma_farthest: the same at the point of either cloud that is farthest from that centre.
        sigma_rotation_deg: deviation of its rotation, degrees.
    """

    inlier_rmse: float
    overlap_source: float
    overlap_target: float
    distance_mean: float
    distance_median: float
    distance_std: float
    distance_p95: float
    sigma_center: float
    sigma_farthest: float
    sigma_rotation_deg: float

    def exchanged(self, scale: float = 1.0) -> Accuracy:
        """Of the inverse: the overlaps change places, and lengths are in the unit of the old source.

        Args:
            scale: of the similarity.
        """
        ours = {f.name: getattr(self, f.name) for f in fields(self)}
        lengths = {n: v / scale for n, v in ours.items() if n.startswith(("inlier", "distance", "sigma"))}
        shares = {"overlap_source": self.overlap_target, "overlap_target": self.overlap_source}
        return replace(self, **{**lengths, **shares, "sigma_rotation_deg": self.sigma_rotation_deg})
