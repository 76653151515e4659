"""Whether a scan that would be ok at a place of a map may be a stranger to it.

In a map the best of very many places is judged, and of a scan that lies nowhere in it one may look as two scans of one
room do. The surface network, which sees every surface point of both, and that of the matches tell these apart.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import expert
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.choosers import Choosers, have_margin
from geomoe3d.pipeline import Pipeline
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.network import opinion_of

LOOKS_STRANGE = (
    "where the scan would lie, its surfaces and those of the map do not look like one place to the networks: "
    "the scan may lie where the map has nothing"
)


def shown(line: Pipeline, pair: Pair, decision: Decision, clock: StageClock) -> Decision:
    """A decision about a scan, and the map around its answer, after the surface network was asked: never ok where that
    and the network of the matches, if that was asked, hold the answer for wrong together. Asked where it is ok and not
    beyond doubt, and a second look asks it of pairs."""
    judgement, look = decision.judgement, line.config.second_look
    limit = max(look.checked_below, expert().locating.checked_below) if look.checked_below > 0 else 0.0
    asked = have_margin(line.second_scorers) and line.second_descriptor is not None
    if decision.answer is None or judgement.status != "ok" or judgement.confidence >= limit or not asked:
        return decision
    seen = line.pair(line.described_again(pair.clouds, clock), pair.matched, pair.matched.viewpoints)
    clock("score")
    liked = Choosers(line.second_scorers, seen, lambda one, other: False).likings([decision.answer])
    opinion = opinion_of(decision.answer)
    heard = 0.0 if opinion is None or opinion.judged is None else float(np.log(opinion.factor))
    return decision.doubted(LOOKS_STRANGE) if liked is not None and liked[0] + heard < 0 else decision
