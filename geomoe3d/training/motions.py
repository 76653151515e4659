"""Motions to judge: for pairs drawn once from fragments with features, what consensus proposes, kept on disk.

A network that scores transforms learns from right and wrong ones of the same pair. Finding them costs more
than a training step, so it is done once, with the estimator of registration itself. Place: between
`geomoe3d.data.draw` and training; about 0.1 s per pair on one core, 0.03 MB on disk.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import EstimatorConfig
from geomoe3d.data.draw import DrawSettings, FragmentPool
from geomoe3d.errors import InputError, OutputError
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.keypoint_alignment import KeypointAligner
from geomoe3d.estimators.proposals import propose
from geomoe3d.runtime.files import make_folder, write_text
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.workers import ProcessPool, SerialPool, WorkerDied, run_surviving
from geomoe3d.training.config import RULES
from geomoe3d.training.fragment_pairs import as_training_pair
from geomoe3d.training.pairs import TrainingPair, write_shard
from geomoe3d.types import BoolArray, Correspondences

PROPOSER_VERSION = 3
"""Raise it with every change of what consensus proposes: motions of two kinds must not share a folder."""
SETTINGS = DrawSettings(
    usual_share=0.7, keypoints=(250, 2000), band_shares=(0.5, 0.3, 0.2), min_inliers=0, whole_share=0.4
)
"""Hard pairs most often, matched as benchmarks do and as registration does; pairs without a right motion
among those proposed teach to doubt."""


_IDENTITY = "motions.json"
_PROPOSING = EstimatorConfig(mutual_round=False, num_aligned=0)


@dataclass(frozen=True)
class MotionReport:
    """What a run came to: shards made and kept, and one sentence per shard that failed."""

    made: int
    kept: int
    failed: tuple[str, ...]


def propose_motions(
    features: str | Path,
    out: str | Path,
    num_pairs: int,
    *,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> MotionReport:
    """Draw pairs and keep them with the motions that consensus proposes, in shards that training reads.

    Args:
        features: folder of fragments with features.
        out: folder of the shards; is made. Shards that are there are kept.
        num_pairs: in all, rounded up to whole shards; those for which no motion is proposed are left out.
        seed: another seed draws other pairs and keypoints.
        workers: processes; the shards are the same for any number.
        progress: called with (shards done, shards in all).

    Raises:
        InputError: no fragments with features there.
        OutputError: the disk refuses, or the folder holds motions of other data, settings or seed.
    """
    pool_identity = FragmentPool(features, SETTINGS, seed, verify=True).identity()
    out = Path(out)
    make_folder(out)
    _check_identity(
        out / _IDENTITY,
        {"seed": seed, "motions": RULES.num_transforms, "proposer": PROPOSER_VERSION, "pool": pool_identity},
    )
    jobs = [
        _Job(Path(features), out / f"motions-{seed:02d}-{k:05d}", seed, k * RULES.pairs_per_shard)
        for k in range(-(-num_pairs // RULES.pairs_per_shard))
    ]
    todo = [job for job in jobs if not job.target.exists()]
    done, failed = len(jobs) - len(todo), []
    pool = SerialPool() if workers == 1 or len(todo) < 2 else ProcessPool(min(workers, len(todo)))
    for job, died in run_surviving(pool, _make, todo):
        if isinstance(died, WorkerDied):
            failed.append(f"{job.target.name}: {died.reason}")
        done += 1
        if progress is not None:
            progress(done, len(jobs))
    return MotionReport(len(todo) - len(failed), len(jobs) - len(todo), tuple(failed))


def _check_identity(path: Path, wanted: dict[str, Any]) -> None:
    """Refuse to mix motions of two origins in one folder; the first run says which it is."""
    if not path.exists():
        write_text(path, json.dumps(wanted) + "\n", force=False)
        return
    try:
        found = parse_json(path.read_text(encoding="utf-8"))
    except ValueError:
        found = {}
    differs = [key for key in wanted if found.get(key) != wanted[key]]
    if differs:
        raise OutputError(
            f"'{path.parent}' holds transforms of another {' and '.join(differs)}; give another folder"
        )


@dataclass(frozen=True)
class _Job:
    """One shard to be made; travels to another process."""

    features: Path
    target: Path
    seed: int
    first: int


def _make(job: _Job) -> None:
    pairs = list(_pairs(_pool(job.features, job.seed), job.first))
    if not pairs:
        raise InputError(
            f"pairs {job.first} to {job.first + RULES.pairs_per_shard - 1} of '{job.features}': consensus proposes "
            "no transform for any; their fragments hold too few points, compute features on a finer grid"
        )
    write_shard(job.target, pairs)


@lru_cache(maxsize=1)
def _pool(features: Path, seed: int) -> FragmentPool:
    return FragmentPool(features, SETTINGS, seed)


def _pairs(pool: FragmentPool, first: int) -> Iterator[TrainingPair]:
    for index in range(first, first + RULES.pairs_per_shard):
        try:
            drawn = pool[index]
            pair = as_training_pair(drawn)
            pair = with_motions(pair, pair.mutual if drawn.whole else None)
        except InputError as error:
            raise InputError(f"pair {index} of '{pool.folder}': {error}") from None
        if pair.motions is not None and len(pair.motions):  # few and bad matches: nothing to judge
            yield pair


def with_motions(pair: TrainingPair, mutual: BoolArray | None = None) -> TrainingPair:
    """The pair with at most `RULES.num_transforms` motions proposed for it, best first; the sensors are at zero.

    Every second one is drawn closer by the keypoints: bare correspondences show the network such motions,
    registration shows it those that consensus fitted. Described fragments have their sensor at zero, see
    `geomoe3d.data.describe.describe_fragment`.

    Args:
        pair: with at least 3 correspondences.
        mutual: (N,) which matches are mutual, where others are to weigh less, as in registration.
    """
    estimator = ConsensusEstimator(num_hypotheses=RULES.num_transforms)
    threshold = _PROPOSING.inlier_threshold * pair.voxel_size
    at_zero = (np.zeros(3), np.zeros(3))
    rows = Correspondences(pair.correspondences.astype(np.float64), mutual=mutual, viewpoints=at_zero)
    found = propose(estimator, Pair(rows, pair.voxel_size, threshold), np.ones(len(rows)), _PROPOSING)
    motions = np.array([h.T_target_source for h in found]).reshape(-1, 4, 4)
    aligner = KeypointAligner(rows.points, threshold)
    for k in range(1, len(motions), 2):
        motions[k] = aligner(motions[k])
    return replace(pair, motions=motions, viewpoints=np.zeros((2, 3)))
