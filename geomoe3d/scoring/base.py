"""What a scorer is: how much it believes in each hypothesis of a pair.

Place: score, between propose and refine. The clouds and the network are two scorers; a hypothesis is ranked
by the product of what all scorers say of it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import PartConfig, ScoringConfig
from geomoe3d.errors import ConfigError
from geomoe3d.parts import Part, Registry
from geomoe3d.types import FloatArray, Score

PairScorer = Callable[[FloatArray], Sequence[Score]]
"""Transforms (K, 4, 4) in local coordinates to one score each, or to none where nothing can be said."""


@dataclass(frozen=True)
class Belief:
    """A score that is no more than its factor."""

    factor: float


class Scorer(Part):
    """Anything that scores hypotheses.

    Attributes:
        selective: True for one that costs much: it is asked about the best few that are clearly different, and
            about every one that then leads.
    """

    selective: ClassVar[bool] = False
    has_margin: ClassVar[bool] = False
    """Whether the confidence was fitted on how clearly it prefers an answer, as one of those who help to choose."""

    @abstractmethod
    def about(self, pair: Pair) -> PairScorer:
        """The scorer of one pair's hypotheses; made once per pair."""

    def unasked(self, known: Sequence[Score]) -> Score:
        """What stands for its word on hypotheses that a selective scorer was not asked about.

        Args:
            known: what it said of others of the pair, at least one.
        """
        return Belief(min(said.factor for said in known))

    def granted(self) -> Score | None:
        """What stands for the word of a selective scorer on a hypothesis that is `settled`; None: it is asked."""
        return None


scorer: Registry[Scorer] = Registry("scorer", "geomoe3d.scoring", lambda: Scorer)
"""Decorator by which a scorer joins, and the choice by name."""


def make_scorers(config: ScoringConfig) -> dict[str, Scorer]:
    """The scorers that a resolved configuration names, in its order. Raises ConfigError: an unknown name, or
    settings that a scorer does not take; CheckpointError, DependencyError: trained weights or a library are
    missing."""
    for name in config.options:
        if name == "network":
            raise ConfigError("scoring.options.network: its weights are given as scoring.weights")
        if name not in config.scorers:
            raise ConfigError(
                f"scoring.options are given for '{name}', which is none of the scorers {', '.join(config.scorers)}"
            )
    options = {**config.options, "network": {"weights": config.weights}}
    return {
        name: scorer.make(PartConfig(name=name, options=options.get(name, {}))) for name in config.scorers
    }
