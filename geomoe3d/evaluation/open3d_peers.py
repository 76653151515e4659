"""Open3D's methods as peers: RANSAC and FGR on correspondences, RANSAC and ICP on clouds.

Where Open3D answers a failed search with the identity, the answer here has no motion. Settings were chosen on
the 3DMatch pairs of four scenes. Place: below `peers`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.peer import CLOUDS, CORRESPONDENCES, peer
from geomoe3d.evaluation.records import Answer, MethodInput
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import FloatArray

_WHEELS = ("open3d-cpu", "open3d")


@peer("open3d-ransac-50k", "open3d", *_WHEELS, inputs=CORRESPONDENCES)
@peer("open3d-ransac-1m", "open3d", *_WHEELS, inputs=CORRESPONDENCES, iterations=1_000_000)
def ransac(
    source: FloatArray,
    target: FloatArray,
    given: MethodInput,
    *,
    iterations: int = 50_000,
    confidence: float = 0.999,
    edge_length_similarity: float = 0.9,
) -> Answer:
    """Open3D's RANSAC on correspondences.

    Open3D's ``correspondence_set`` pairs nearest points under its motion and is no classification of the
    given rows; after a failed search that motion is the identity, which may well bring points together.

    Args:
        source, target, given: as in `peer.Register`.
        iterations: most samples.
        confidence: stops when this sure.
        edge_length_similarity: a sample is skipped when two of its edges differ by more than this factor.
    """
    import open3d as o3d

    registration = o3d.pipelines.registration
    o3d.utility.random.seed(given.seed)
    answer = registration.registration_ransac_based_on_correspondence(
        _cloud(source),
        _cloud(target),
        _paired(len(source)),
        given.inlier_threshold,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [registration.CorrespondenceCheckerBasedOnEdgeLength(edge_length_similarity)],
        registration.RANSACConvergenceCriteria(iterations, confidence),
    )
    T = np.array(answer.transformation)
    residuals = np.linalg.norm(transform_points(T, source) - target, axis=1)
    return Answer(T if not _is_identity(T) and (residuals < given.inlier_threshold).sum() >= 3 else None)


@peer("open3d-fgr", "open3d", *_WHEELS, inputs=CORRESPONDENCES)
def fast_global(
    source: FloatArray,
    target: FloatArray,
    given: MethodInput,
    *,
    distance: float = 0.5,
    iterations: int = 64,
    tuple_count: int = 1000,
) -> Answer:
    """Open3D's Fast Global Registration on correspondences.

    The library's defaults do not anneal (``decrease_mu`` False) and do not know that lengths are metric;
    here they do, which is worth over 30 points of recall.

    Args:
        source, target, given: as in `peer.Register`.
        distance: of the line process, in inlier thresholds.
        iterations: of the optimisation.
        tuple_count: triples tried by the tuple test.
    """
    import open3d as o3d

    registration = o3d.pipelines.registration
    o3d.utility.random.seed(given.seed)
    option = registration.FastGlobalRegistrationOption(
        use_absolute_scale=True,
        decrease_mu=True,
        maximum_correspondence_distance=distance * given.inlier_threshold,
        iteration_number=iterations,
        maximum_tuple_count=tuple_count,
    )
    answer = registration.registration_fgr_based_on_correspondence(
        _cloud(source), _cloud(target), _paired(len(source)), option
    )
    T = np.array(answer.transformation)
    return Answer(None if _is_identity(T) else T)


@peer("open3d-feature-ransac", "open3d", *_WHEELS, inputs=CLOUDS)
def feature_ransac(
    source: FloatArray,
    target: FloatArray,
    given: MethodInput,
    *,
    iterations: int = 100_000,
    confidence: float = 0.999,
    mutual: bool = False,
    distance: float = 2.0,
    edge_length_similarity: float = 0.9,
) -> Answer:
    """Open3D end to end as in its tutorial: voxels, normals, FPFH, RANSAC on nearest features.

    Args:
        source, target, given: as in `peer.Register`.
        iterations: most samples.
        confidence: stops when this sure.
        mutual: whether only mutual nearest features are sampled.
        distance: residual limit, in voxels.
        edge_length_similarity: as in `ransac`.
    """
    import open3d as o3d

    registration = o3d.pipelines.registration
    clock = StageClock()
    clock("preprocess")
    thinned = [_thinned(points, given.voxel_size) for points in (source, target)]
    if min(len(cloud.points) for cloud in thinned) < 3:
        return Answer(None)
    clock("features")
    search = o3d.geometry.KDTreeSearchParamHybrid(5 * given.voxel_size, 100)
    features = [
        registration.compute_fpfh_feature(cloud, search)  # type: ignore[call-arg]
        for cloud in thinned
    ]
    clock("solve")
    o3d.utility.random.seed(given.seed)
    limit = distance * given.voxel_size
    answer = registration.registration_ransac_based_on_feature_matching(
        thinned[0],
        thinned[1],
        features[0],
        features[1],
        mutual,
        limit,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(edge_length_similarity),
            registration.CorrespondenceCheckerBasedOnDistance(limit),
        ],
        registration.RANSACConvergenceCriteria(iterations, confidence),
    )
    stages = {name: value for name, value in clock.stop().items() if name != "total"}
    T = np.array(answer.transformation)
    failed = _is_identity(T) or len(answer.correspondence_set) < 3
    return Answer(None if failed else T, stages=stages)


@peer("icp-identity", "open3d", *_WHEELS, inputs=CLOUDS, local=True)
def icp_from_identity(
    source: FloatArray,
    target: FloatArray,
    given: MethodInput,
    *,
    distance: float = 10.0,
    iterations: int = 100,
) -> Answer:
    """Open3D's point-to-plane ICP from the identity: what a local method does without a first guess.

    Args:
        source, target, given: as in `peer.Register`.
        distance: largest distance of matched points, in voxels.
        iterations: most steps.
    """
    import open3d as o3d

    registration = o3d.pipelines.registration
    answer = registration.registration_icp(
        _thinned(source, given.voxel_size),
        _thinned(target, given.voxel_size),
        distance * given.voxel_size,
        np.eye(4),
        registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(max_iteration=iterations),
    )
    found = len(answer.correspondence_set) >= RULES.least_matched
    return Answer(np.array(answer.transformation) if found else None)


def _is_identity(T: FloatArray) -> bool:
    """Exactly, as no estimate from data is: what Open3D answers when it found nothing."""
    return bool(np.array_equal(T, np.eye(4)))


def _cloud(points: FloatArray) -> Any:
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points)))


def _paired(count: int) -> Any:
    """Row i belongs to row i."""
    import open3d as o3d

    return o3d.utility.Vector2iVector(np.repeat(np.arange(count, dtype=np.int32)[:, None], 2, axis=1))


def _thinned(points: FloatArray, voxel_size: float) -> Any:
    """Open3D's cloud on a grid, normals over two voxels, turned towards the sensor at the file's zero."""
    import open3d as o3d

    cloud = _cloud(points).voxel_down_sample(voxel_size)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel_size, 30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    return cloud
