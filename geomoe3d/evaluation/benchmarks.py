"""Which pairs are registered and what is true of them: the published benchmarks, unrelated pairs, any folder.

Nothing is read here but ground truth files; clouds come later, through tracks. Cost: 0.1 s for 843 pairs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomoe3d.data.collection import fragment_number, open_collection
from geomoe3d.data.threedmatch import BENCHMARKS, load_benchmark
from geomoe3d.errors import InputError
from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.records import EvaluationPair

UNRELATED = "unrelated"


def load_pairs(
    benchmark: str, root: str | Path | None = None, *, num_unrelated: int = RULES.num_unrelated
) -> list[EvaluationPair]:
    """The pairs of a benchmark, scene by scene.

    Args:
        benchmark: 3DMatch, 3DLoMatch; ``unrelated``: seeded pairs of fragments of different 3DMatch scenes;
            or a folder of posed fragments in any layout of `geomoe3d.data.collection` (a generated set, too).
        root: folder of the published benchmarks; None takes `geomoe3d.data.threedmatch.find_data_root`.
        num_unrelated: pairs of ``unrelated``, at least 1.

    Raises:
        InputError: no such benchmark or folder, it lists no pairs, or as many unrelated pairs cannot be.
        FormatError: a ground truth file is broken.
    """
    if benchmark in BENCHMARKS:
        return _published(root, benchmark)
    if benchmark == UNRELATED:
        return _unrelated(root, num_unrelated)
    if not Path(benchmark).is_dir():
        names = ", ".join((*BENCHMARKS, UNRELATED))
        raise InputError(f"there is no benchmark '{benchmark}'; there are {names}, or give a folder")
    return _folder(Path(benchmark))


def thin_out(pairs: list[EvaluationPair], every: int) -> list[EvaluationPair]:
    """Every n-th pair, from the first on, in the order of the benchmark."""
    if every < 1:
        raise InputError(f"every must be at least 1, found {every}")
    return pairs[::every]


def _published(root: str | Path | None, benchmark: str) -> list[EvaluationPair]:
    published = load_benchmark(root, benchmark)
    raw = load_benchmark(root, benchmark, raw=True)
    return [
        EvaluationPair(
            f"{pair.scene}/{pair.source_index}-{pair.target_index}",
            benchmark,
            pair.scene,
            pair.source,
            pair.target,
            pair.T_target_source,
            as_written.T_target_source,
            pair.overlap,
            pair.information,
            abs(pair.target_index - pair.source_index) == 1,
        )
        for pair, as_written in zip(published, raw, strict=True)
    ]


def _unrelated(root: str | Path | None, count: int) -> list[EvaluationPair]:
    """A seeded choice; a longer list begins with the shorter one."""
    if count < 1:
        raise InputError(f"there must be at least 1 unrelated pair, found {count}")
    fragments: dict[str, list[Path]] = {}
    for pair in load_benchmark(root, "3DMatch"):
        known = fragments.setdefault(pair.scene, [])
        known += [path for path in (pair.source, pair.target) if path not in known]
    names = sorted(fragments)
    if len(names) < 2:
        raise InputError(f"unrelated pairs need two scenes; the benchmark folder holds {len(names)}")
    rng = np.random.default_rng(0)
    chosen: dict[str, EvaluationPair] = {}
    possible = sum(len(fragments[a]) * len(fragments[b]) for a in names for b in names if a != b)
    if count > possible:
        raise InputError(f"there are only {possible} unrelated pairs, not {count}")
    while len(chosen) < count:
        one, other = (names[k] for k in rng.permutation(len(names))[:2])
        source, target = (fragments[name][rng.integers(len(fragments[name]))] for name in (one, other))
        key = f"{one}/{fragment_number(source)}--{other}/{fragment_number(target)}"
        chosen.setdefault(key, EvaluationPair(key, UNRELATED, one, source, target, None))
    return list(chosen.values())


def _folder(folder: Path) -> list[EvaluationPair]:
    collection = open_collection(folder)
    if not collection.pairs:
        raise InputError(f"'{folder}' lists no pairs; it needs a gt.log or poses beside its clouds")
    pairs: dict[str, EvaluationPair] = {}
    for pair in collection.pairs:
        key = f"{pair.scene}/{pair.source.stem}--{pair.target.stem}"
        numbers = fragment_number(pair.source), fragment_number(pair.target)
        if key in pairs:  # the same pair in two lists of one archive
            continue
        pairs[key] = EvaluationPair(
            key,
            folder.name or str(folder),
            pair.scene,
            pair.source,
            pair.target,
            pair.T_target_source,
            overlap=pair.overlap,
            consecutive=abs(numbers[0] - numbers[1]) == 1,
        )
    return list(pairs.values())
