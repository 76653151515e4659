"""Which pairs deserve a second, slower look: those that could tie groups which are still apart.

Place: after a round of pairs that were looked at once. A second look asks another descriptor and coarser grids and
takes several times as long, so it is not for every pair: of each group that is apart it is for the pairs to
other groups that came out surest without being sure, and for those whose scans look most alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from geomoe3d.config import expert
from geomoe3d.multiway.rules import Group
from geomoe3d.types import FloatArray

PairKey = tuple[int, int]


def doubtful_pairs(
    groups: Sequence[Group],
    usable: Iterable[int],
    similarity: FloatArray,
    confidence: Callable[[PairKey], float | None],
    *,
    sequence: bool = False,
) -> list[PairKey]:
    """Pairs (i, j), i < j, of scans of different groups that are worth a second look.

    Args:
        groups: as they stand, the largest first; for that one nothing is asked, since all others are.
        usable: numbers of the scans that can be registered.
        similarity: (K, K) of the scans.
        confidence: of the first look at a pair, 0 where there was none; None: it needs no second look.
        sequence: whether scans with neighbouring numbers were taken one after the other.
    """
    scans, wanted = set(usable), set[PairKey]()
    for group in groups[1:]:
        inside, outside = scans & group.poses.keys(), scans - group.poses.keys()
        crossing = [(min(i, j), max(i, j)) for i in inside for j in outside]
        sure = {pair: confidence(pair) for pair in crossing}
        open_pairs = {pair: value for pair, value in sure.items() if value is not None}
        limits = expert().many_pairs
        count = min(limits.most_doubtful, limits.least_doubtful + limits.doubtful_per_scan * len(inside))
        likely = sorted(open_pairs, key=lambda pair: (-open_pairs[pair], pair))
        alike = sorted(open_pairs, key=lambda pair: (-similarity[pair], pair))
        wanted |= {pair for pair in likely[:count] if open_pairs[pair] > 0} | set(alike[:count])
        wanted |= {pair for pair in open_pairs if sequence and pair[1] - pair[0] == 1}
    return sorted(wanted)
