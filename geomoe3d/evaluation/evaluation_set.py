"""What a run of predictions is made on, and how a stored run finds its pairs again."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomoe3d.data.threedmatch import BENCHMARKS
from geomoe3d.errors import FormatError, InputError
from geomoe3d.evaluation.benchmarks import UNRELATED, load_pairs, thin_out
from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.records import EvaluationPair, RunInfo


@dataclass(frozen=True)
class EvaluationSet:
    """What a set of predictions is made on.

    Folders become absolute, so that a run is scored from any other folder, too.

    Attributes:
        benchmark: as in `load_pairs`.
        track: as in `geomoe3d.evaluation.tracks`.
        root: folder of the published benchmarks, or None.
        every: every n-th pair; always 1 for ``unrelated``, whose number is given.
        num_unrelated: pairs of the benchmark ``unrelated``.
        seed: of the methods.
    """

    benchmark: str
    track: str
    root: str | None = None
    every: int = 1
    num_unrelated: int = RULES.num_unrelated
    seed: int = 0

    def __post_init__(self) -> None:
        """Bring the folders and the share of pairs into the one form that is stored and compared."""
        if self.benchmark == UNRELATED:
            object.__setattr__(self, "every", 1)
        elif self.benchmark not in BENCHMARKS and Path(self.benchmark).is_dir():
            object.__setattr__(self, "benchmark", str(Path(self.benchmark).resolve()))
        if self.root is not None and Path(self.root).is_dir():
            object.__setattr__(self, "root", str(Path(self.root).resolve()))

    def pairs(self) -> list[EvaluationPair]:
        """The pairs, in the benchmark's order."""
        return thin_out(load_pairs(self.benchmark, self.root, num_unrelated=self.num_unrelated), self.every)


def load_run_pairs(info: RunInfo) -> list[EvaluationPair]:
    """The pairs that a stored run was made on, with their truth, read again from the benchmark. Raises
    InputError: the benchmark is not there any more, or its ground truth is another than the run saw;
    FormatError: the run does not say what it was made on."""
    try:
        given = info.identity["pairs"]
        chosen = EvaluationSet(
            given["benchmark"], info.track, given["root"], given["every"], given["num_unrelated"]
        )
        expected = given["fingerprint"]
    except (KeyError, TypeError):
        raise FormatError(f"run '{info.label}' does not say which pairs it was made on") from None
    pairs = chosen.pairs()
    if fingerprint(pairs) != expected:
        raise InputError(
            f"the ground truth of '{info.benchmark}' is not the one that run '{info.label}' was predicted "
            "on; set GEOMOE3D_DATA to the same data, or predict again with --fresh"
        )
    return pairs


def fingerprint(pairs: list[EvaluationPair]) -> str:
    """Hash of the pairs' names and true motions."""
    digest = hashlib.sha256()
    for pair in pairs:
        digest.update(pair.id.encode())
        if pair.T_target_source is not None:
            digest.update(np.round(pair.T_target_source, 9).astype("<f8").tobytes())
    return digest.hexdigest()[:16]
