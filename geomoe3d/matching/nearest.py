"""Nearest neighbours in feature space, exact, with bounded memory.

Place: match. Blocks of the similarity matrix are formed by matrix products, about 4 MB at a time for each
thread; O(n m) time: on two cores 5,000 against 5,000 points take some 20 ms, 30,000 against 30,000 0.7 s.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.config import MatchingConfig
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.matching.base import BLOCK_ENTRIES, Matcher, features_of, matcher
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import BoolArray, Correspondences, Float32Array, IntArray, PreparedCloud

if TYPE_CHECKING:
    from typing_extensions import Self


@matcher("one_way", "mutual", "ratio")
@dataclass(frozen=True)
class NearestMatcher(Matcher):
    """Nearest neighbours in feature space; see `match`.

    Attributes:
        config: method (its name), neighbours and largest ratio; the limit of the call counts.
    """

    config: MatchingConfig = field(default_factory=MatchingConfig)

    @classmethod
    def from_config(cls, config: MatchingConfig) -> Self:
        """As configured."""
        return cls(config)

    def __call__(
        self,
        source: PreparedCloud,
        target: PreparedCloud,
        *,
        limit: int,
        seed: int = 0,
        with_ratio: bool = False,
    ) -> Correspondences:
        """See `Matcher`."""
        config = self.config.model_copy(update={"max_correspondences": limit})
        return match(source, target, config, seed=seed, with_ratio=with_ratio)


def match(
    source: PreparedCloud,
    target: PreparedCloud,
    config: MatchingConfig,
    *,
    seed: int = 0,
    with_ratio: bool = True,
) -> Correspondences:
    """Putative correspondences between two clouds with features.

    Methods: ``one_way`` keeps for every source point its nearest targets; ``mutual`` of these only pairs
    that are each other's nearest; ``ratio`` only pairs whose distance is at most ``max_ratio`` of the
    second best. At most ``max_correspondences`` are kept, in source order: mutual ones first, filled up by a
    seeded random choice of the others. (The most distinctive by ratio crowd on a few objects and fix the
    motion less well than random ones do.)

    Args:
        source: cloud with features.
        target: cloud with features.
        config: see above.
        seed: decides what is kept beyond the limit.
        with_ratio: False leaves the ratio out, a quarter of the time, unless the method needs it.

    Raises:
        InputError: a cloud without features.
    """
    index, distance, ratio, mutual = nearest_features(
        *features_of(source, target), config.neighbors, with_ratio or config.name == "ratio"
    )
    rows = np.repeat(np.arange(len(source)), index.shape[1])
    columns, mutual = index.ravel(), mutual.ravel()
    keep: BoolArray = np.ones(len(rows), dtype=np.bool_)
    if config.name == "mutual":
        keep = mutual
    elif config.name == "ratio":
        assert ratio is not None
        keep = ratio.ravel() <= config.max_ratio
    found = replace(
        Correspondences.between(source, target, rows, columns),
        feature_distance=distance.ravel(),
        ratio=None if ratio is None else ratio.ravel(),
        mutual=mutual,
    ).take(keep)
    limit = config.max_correspondences
    return found.take(drawn_rows(found.source, source.voxel_size, limit, seed, first=found.mutual))


@single_blas_thread()
def nearest_features(
    source: Float32Array, target: Float32Array, neighbors: int, with_ratio: bool = True
) -> tuple[IntArray, Float32Array, Float32Array | None, BoolArray]:
    """The nearest target features of each source feature, and whether the choice is mutual.

    Args:
        source: (n, d) unit features.
        target: (m, d) unit features.
        neighbors: targets k per source feature; fewer where m is smaller.
        with_ratio: False leaves out the ratio, None then.

    Returns:
        Index (n, k) of the nearest targets, best first; their Euclidean distance (n, k); the ratio (n, k)
        of that distance to the one of the next best target outside the k (1 where there is none or where
        both are zero); and whether the source is also the nearest to that target (n, k), shared ties
        included.
    """
    k = min(neighbors, len(target))
    index = np.empty((len(source), k), dtype=np.int64)
    best = np.empty((len(source), k), dtype=np.float32)
    beyond = np.full(len(source), -np.inf, dtype=np.float32)
    column_best = np.full(len(target), -np.inf, dtype=np.float32)
    step = max(1, BLOCK_ENTRIES // len(target))
    lock = threading.Lock()

    def fill(start: int) -> None:
        similarity = source[start : start + step] @ target.T
        stop = start + len(similarity)
        rows = np.arange(len(similarity))
        of_columns = similarity.max(0)
        with lock:  # a maximum is the same in whatever order
            np.maximum(column_best, of_columns, out=column_best)
        for rank in range(k):
            choice = similarity.argmax(1)
            index[start:stop, rank] = choice
            best[start:stop, rank] = similarity[rows, choice]
            if rank + 1 < k or with_ratio:
                similarity[rows, choice] = -np.inf
        if k < len(target) and with_ratio:
            beyond[start:stop] = similarity.max(1)

    each(fill, range(0, len(source), step))
    distance = np.sqrt(np.maximum(2 - 2 * best, 0))
    # Comparing values instead of indices saves the slow search along the columns.
    mutual: BoolArray = best >= column_best[index]
    mutual[:, 1:] = False  # only the first choice can be each other's nearest
    if not with_ratio:
        return index, distance, None, mutual
    next_distance = np.sqrt(np.maximum(2 - 2 * np.where(np.isfinite(beyond), beyond, 1), 0))[:, None]
    usable = np.isfinite(beyond)[:, None] & (next_distance > 0)
    ratio = np.where(usable, distance / np.where(usable, next_distance, 1), 1)
    return index, distance, np.minimum(ratio, 1).astype(np.float32), mutual
