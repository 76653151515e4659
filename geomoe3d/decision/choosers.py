"""Those who help to choose among a few refined hypotheses, and by how much they prefer one: the margin.

Place: refine and decide, in a second look. They cost too much, or are too sure, to score every hypothesis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.scoring.base import PairScorer, Scorer
from geomoe3d.types import FloatArray, Hypothesis


def have_margin(scorers: Mapping[str, Scorer]) -> bool:
    """Whether there are any, and the confidence was fitted on the word of all of them."""
    return bool(scorers) and all(scorer.has_margin for scorer in scorers.values())


class Choosers:
    """Scorers of one pair that help to choose; build once per pair.

    Args:
        scorers: by name.
        pair: clouds with the features that the scorers want.
        differ: whether two hypotheses are clearly different transforms.
    """

    def __init__(
        self, scorers: Mapping[str, Scorer], pair: Pair, differ: Callable[[Hypothesis, Hypothesis], bool]
    ) -> None:
        self._scorers, self._pair, self._differ = scorers, pair, differ
        self._bound: list[PairScorer] | None = None
        self._liked: dict[bytes, float] = {}

    def likings(self, hypotheses: Sequence[Hypothesis]) -> FloatArray | None:
        """(K,) natural logarithms of what they multiply scores by; None where they say nothing of the pair."""
        if self._bound is None:  # not before it is needed
            self._bound = [scorer.about(self._pair) for scorer in self._scorers.values()]
        names = [h.T_target_source.tobytes() for h in hypotheses]
        new = {
            name: h.T_target_source
            for name, h in zip(names, hypotheses, strict=True)
            if name not in self._liked
        }
        if new:  # the others were asked about before
            transforms = np.array(list(new.values()))
            told = [said for ask in self._bound if len(said := ask(transforms)) == len(new)]
            if not told:
                return None
            factors = np.prod([[score.factor for score in said] for said in told], axis=0)
            liked = np.log(np.maximum(factors, np.finfo(float).tiny))
            self._liked.update(zip(new, liked.tolist(), strict=True))
        return np.array([self._liked[name] for name in names])

    def margin(self, answer: Hypothesis, others: Iterable[Hypothesis | None]) -> float | None:
        """By how much they prefer an answer to the best that is clearly different, a logarithm; see `likings`.

        An answer without any such is measured against a verdict that says nothing. None where others than the surface
        network choose: the confidence was fitted on its word alone.
        """
        if not have_margin(self._scorers):
            return None
        different = [h for h in others if h is not None and self._differ(answer, h)]
        liked = self.likings([answer, *different])
        return (
            None if liked is None else float(liked[0] - liked[1:].max(initial=-np.inf if different else 0.0))
        )
