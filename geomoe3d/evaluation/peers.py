"""Other people's methods by name, run by the rules of ours: same input, same clock, good settings.

What they share is in `peer`, those of Open3D are in `open3d_peers`, the others are here. Settings were chosen
on the 3DMatch pairs of four scenes.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.estimators.weighted_svd import WeightedSvdEstimator
from geomoe3d.evaluation import open3d_peers  # noqa: F401 - registers them
from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.peer import CLOUDS, CORRESPONDENCES, PEERS, peer
from geomoe3d.evaluation.records import Answer, MethodInput
from geomoe3d.filters.spectral import SpectralFilter
from geomoe3d.geometry.se3 import make_transform, shift_frames
from geomoe3d.types import Correspondences, FloatArray

__all__ = ["PEERS"]


@peer("spectral", "numpy", "numpy", inputs=CORRESPONDENCES)
def spectral_matching(
    source: FloatArray, target: FloatArray, given: MethodInput, *, kept_share: float = 0.1
) -> Answer:
    """Spectral matching: the best tenth by the leading eigenvector of length compatibility, weighted SVD.

    Source: Leordeanu and Hebert, ICCV 2005, with the share that registration papers keep. The eigenvector is
    `geomoe3d.filters.spectral.SpectralFilter`.

    Args:
        source, target, given: as in `peer.Register`.
        kept_share: share of the correspondences that are fitted; these are its inliers.
    """
    rows = np.hstack([source, target])
    weighed = SpectralFilter()(Correspondences(rows), voxel_size=given.voxel_size, seed=given.seed)
    count = max(3, round(kept_share * len(rows)))
    kept = np.zeros(len(rows), dtype=np.bool_)
    kept[np.argsort(-weighed.weights, kind="stable")[:count]] = True
    kept &= weighed.weights > 0
    found = WeightedSvdEstimator()(
        rows, np.where(kept, weighed.weights, 0), inlier_threshold=given.inlier_threshold
    )
    return Answer(found[0].T_target_source if found else None, inliers=kept)


@peer("small-gicp", "small_gicp", "small_gicp", inputs=CLOUDS, local=True)
def small_gicp_from_identity(
    source: FloatArray,
    target: FloatArray,
    given: MethodInput,
    *,
    distance: float = 10.0,
    iterations: int = 100,
) -> Answer:
    """small_gicp's GICP from the identity, one thread.

    Its ``converged`` is true even where nothing matched, so matches count.

    Args:
        source, target, given: as in `peer.Register`.
        distance: largest distance of matched points, in voxels.
        iterations: most steps.
    """
    import small_gicp

    answer = small_gicp.align(
        target,
        source,
        registration_type="GICP",
        downsampling_resolution=given.voxel_size,
        max_correspondence_distance=distance * given.voxel_size,
        num_threads=1,
        max_iterations=iterations,
    )
    return Answer(np.array(answer.T_target_source) if answer.num_inliers >= RULES.least_matched else None)


@peer("kiss-matcher", "kiss_matcher", "kiss-matcher", inputs=CLOUDS)
def kiss_matcher(source: FloatArray, target: FloatArray, given: MethodInput) -> Answer:
    """KISS-Matcher end to end at the benchmark's voxel size, otherwise with its defaults.

    It has no seed and works in threads: answers differ a little from run to run. Making the matcher costs
    microseconds, so each pair gets a fresh one. Its ``valid`` decides whether there is an answer.
    """
    if not all(_has_surface(points, 3 * given.voxel_size) for points in (source, target)):
        return Answer(None)
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(given.voxel_size))
    answer = matcher.estimate(source, target)
    if not answer.valid:
        return Answer(None)
    T = make_transform(np.array(answer.rotation), np.array(answer.translation).ravel())
    stages = {
        "preprocess": matcher.get_processing_time(),
        "features": matcher.get_extraction_time(),
        "match": matcher.get_matching_time(),
        "solve": matcher.get_rejection_time() + matcher.get_solver_time(),
    }
    return Answer(T, stages=stages)


@peer(
    "gc-ransac",
    "pygcransac",
    "pygcransac",
    inputs=CORRESPONDENCES,
    limits="there are wheels for Linux and Python up to 3.11",
)
def graph_cut_ransac(
    source: FloatArray,
    target: FloatArray,
    given: MethodInput,
    *,
    iterations: int = 100_000,
    least_iterations: int = 1000,
    confidence: float = 0.999,
    spatial_coherence: float = 0.0,
    neighborhood_size: float = 4.0,
    early_rejection: bool = True,
    early_rejection_ratio: float = 0.1,
) -> Answer:
    """Graph-Cut RANSAC (``pygcransac``) on correspondences. It has no seed: answers differ from run to run.

    Args:
        source, target, given: as in `peer.Register`.
        iterations: most samples.
        least_iterations: fewest samples.
        confidence: stops when this sure.
        spatial_coherence: weight of the neighbourhood in the local optimisation.
        neighborhood_size: as the library counts it.
        early_rejection: whether the sequential probability ratio test drops bad models early.
        early_rejection_ratio: the inlier ratio that the test starts from.
    """
    import pygcransac

    rows = np.hstack([source, target])
    low = rows.min(axis=0)  # its grid wants coordinates that are not negative
    T, _ = pygcransac.findRigidTransform(
        np.ascontiguousarray(rows - low),
        np.ones(len(rows)),
        threshold=given.inlier_threshold,
        conf=confidence,
        spatial_coherence_weight=spatial_coherence,
        max_iters=iterations,
        min_iters=least_iterations,
        use_sprt=early_rejection,
        min_inlier_ratio_for_sprt=early_rejection_ratio,
        sampler=0,
        neighborhood=0,
        neighborhood_size=neighborhood_size,
        use_space_partitioning=False,
    )
    # The library's motion is for rows, p' = p T, hence the transpose.
    return Answer(None if T is None else shift_frames(np.array(T).T, low[:3], low[3:]))


def _has_surface(points: FloatArray, radius: float) -> bool:
    """Whether enough points have neighbours to fit normals to: KISS-Matcher crashes without any.

    Large clouds are not looked at: this is on the peer's clock, and only sparse ones are at fault.
    """
    if len(points) >= 3000:
        return True
    from scipy.spatial import KDTree

    neighbors = KDTree(points).query_ball_point(points, radius, return_length=True)
    return int((np.asarray(neighbors) > 10).sum()) >= 50
