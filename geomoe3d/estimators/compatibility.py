"""Which correspondences agree with each other: what consensus asks before it fits anything.

Compatibility of all pairs, seeds among them, and for each seed the correspondences that share most compatible partners
with it (Chen et al., SC2-PCR, CVPR 2022). Lengths are in inlier thresholds.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.geometry.draws import Ranks
from geomoe3d.runtime.threads import each
from geomoe3d.types import BoolArray, Float32Array, FloatArray, IntArray

BLOCK = 250  # rows of the matrix of all pairs that one thread works on: they stay in its cache
PAIR_BLOCK = 125  # the same where several such blocks are worked on


def bundle_weights(target: FloatArray) -> Float32Array:
    """1 / sqrt(number of correspondences that share the target point), (N,) float32."""
    order = np.lexsort(target.T)
    ordered = target[order]
    group = np.cumsum((ordered[1:] != ordered[:-1]).any(1))
    group = np.concatenate([np.zeros(min(len(target), 1), dtype=group.dtype), group])
    weights: Float32Array = np.empty(len(target), dtype=np.float32)
    weights[order] = 1.0 / np.sqrt(np.bincount(group)[group])
    return weights


def distance_factors(points: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Left and right (N, 5) of points (N, 3), whose product with those of others is the square of the distance:
    [-2a, |a|^2, 1] . [b, 1, |b|^2] = |a - b|^2, without a further pass over all pairs."""
    squares = (points * points).sum(1, keepdims=True)
    ones = np.ones_like(squares)
    return np.hstack([-2 * points, squares, ones]), np.hstack([points, ones, squares])


def distances(left: Float32Array, right: Float32Array) -> Float32Array:
    """(N, M) Euclidean distances, by the left and right of `distance_factors`, of points near zero."""
    found: Float32Array = left @ right.T
    np.maximum(found, 0, out=found)
    np.sqrt(found, out=found)
    return found


def compatibility(
    source: Float32Array,
    target: Float32Array,
    tolerance: float = 1.0,
    surroundings: Surroundings | None = None,
) -> tuple[BoolArray, Float32Array]:
    """Which source points lie within a threshold of each other, (N, N), and how compatible two correspondences are,
    in [0, 1].

    0 where they do not preserve length; else 1, or how well their planes agree where those are known.
    Points (N, 3) in inlier thresholds, as the tolerance; the diagonal of the second (N, N) is zero.
    """
    close = np.empty((len(source), len(source)), dtype=np.bool_)  # a quarter of what distances would fill
    compatible = np.empty(close.shape, dtype=np.float32)

    agree = None if surroundings is None else surroundings.of_pairs(source, target)
    (p, p_rest), (q, q_rest) = distance_factors(source), distance_factors(target)

    def fill(some: IntArray) -> None:
        # Both are symmetric: from the diagonal on, and the same below it.
        rows, rest = slice(some[0], some[-1] + 1), slice(some[0], None)
        near, gap = distances(p[rows], p_rest[rest]), distances(q[rows], q_rest[rest])
        gap -= near
        found = np.less(np.abs(gap, out=gap), tolerance, out=gap, casting="unsafe")
        within = near < 1.0
        if agree is not None:
            found *= agree(rows, near)
        close[rows, rest], compatible[rows, rest] = within, found
        close[rest, rows], compatible[rest, rows] = within.T, found.T

    each(fill, blocks(np.arange(len(source)), PAIR_BLOCK))
    np.fill_diagonal(compatible, 0)
    return close, compatible


def blocks(rows: IntArray, size: int = BLOCK) -> list[IntArray]:
    """Rows in parts of at most ``size``, the same ones for any number of threads."""
    return [rows[start : start + size] for start in range(0, len(rows), size)]


def strengths(support: Float32Array, close: BoolArray) -> Float32Array:
    """Support (N,), half of it where one of those that are ``close`` (N, N) has more, so that a dense bundle of wrong
    matches does not take all places."""
    beaten = (close & (support[None, :] > support[:, None])).any(1)
    return np.where(beaten, np.float32(0.5) * support, support)


def choose_seeds(strength: Float32Array, ranks: Ranks, limit: int) -> IntArray:
    """Rows with the largest strength, and a quarter of the limit drawn from all others, those of the lowest ranks: they
    give a second, weaker motion its proposals."""
    if len(strength) <= limit:
        return np.arange(len(strength))
    order = np.argsort(-strength, kind="stable")
    strongest = limit - limit // 4
    rest = order[strongest:]
    drawn = rest[np.argsort(ranks[rest], kind="stable")[: limit // 4]]
    return np.concatenate([order[:strongest], drawn])


def local_sets(
    compatible: Float32Array, seeds: IntArray, vote: Float32Array, size: int, witnesses: IntArray
) -> tuple[IntArray, Float32Array]:
    """For each seed the ``size`` correspondences with the largest second-order compatibility.

    Returns:
        Rows (M, size + 1), the seed first, and their weights (M, size + 1): S_ij = C_ij v_j sum_k C_ik
        v_k C_kj over the ``witnesses`` k; the seed weighs as much as its best partner. Partners without any
        compatibility weigh nothing.
    """
    size = min(size, len(compatible) - 1)
    first = compatible[seeds]
    second = np.ascontiguousarray(first[:, witnesses] * vote[witnesses]) @ compatible[witnesses]
    second *= first
    second *= vote
    members = np.empty((len(seeds), size), dtype=np.int64)
    weights = np.empty((len(seeds), size), dtype=np.float32)
    rows = np.arange(len(seeds))
    for rank in range(size):  # a few passes for the maximum are much faster than a partition
        members[:, rank] = second.argmax(1)
        weights[:, rank] = second[rows, members[:, rank]]
        second[rows, members[:, rank]] = -1
    seed_weight = weights.max(1, keepdims=True) + np.float32(1e-6)
    return np.concatenate([seeds[:, None], members], 1), np.concatenate([seed_weight, weights], 1)
