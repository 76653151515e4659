"""What a trained network says of hypotheses, from the correspondences under each of them.

The network that ships with the package scores transforms: it sees the correspondences as they lie under one and
gives a logit that it is right (`geomoe3d.networks.motion_judge`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import expert
from geomoe3d.errors import CheckpointError
from geomoe3d.networks.weight_files import DEFAULT_WEIGHTS, check_weights, judges_transforms
from geomoe3d.runtime.files import file_hash
from geomoe3d.runtime.sources import source_hash
from geomoe3d.scoring.base import PairScorer, Scorer, scorer
from geomoe3d.types import FilterOutput, FloatArray, Hypothesis, Score

if TYPE_CHECKING:
    from geomoe3d.networks.motion_judge import Judged, MotionJudge

NETWORK = "network"
_RUN_BY = "geomoe3d.networks.motion_judge"


@dataclass(frozen=True)
class Opinion:
    """What the network says of one hypothesis.

    Attributes:
        verdict: logit that it is right.
        judged: weights of the correspondences under it; None where the verdict is assumed, not given.
    """

    verdict: float
    judged: Judged | None = field(default=None, compare=False)

    @property
    def factor(self) -> float:
        """exp(verdict / 2), the verdict bounded to [-8, 8]."""
        known = expert().network
        return float(np.exp(known.weight * min(max(self.verdict, -known.most), known.most)))

    @property
    def output(self) -> FilterOutput | None:
        """Weights of the correspondences under the hypothesis, or None where it was not asked."""
        return None if self.judged is None else self.judged.output


def opinion_of(hypothesis: Hypothesis | None) -> Opinion | None:
    """What the network says of a hypothesis, given or assumed; None without a network."""
    found = None if hypothesis is None else hypothesis.scores.get(NETWORK)
    return found if isinstance(found, Opinion) else None


@scorer(NETWORK)
class NetworkScorer(Scorer):
    """A network that scores transforms as scorer; loaded when it is first needed.

    Args:
        weights: a .safetensors file with its card, or the name of weights that ship with the package; None takes
            these.

    Raises:
        CheckpointError: not found, damaged, or of another kind of network.
    """

    selective: ClassVar[bool] = True

    def __init__(self, weights: str | Path | None = None) -> None:
        weights = weights or DEFAULT_WEIGHTS
        self._path = check_weights(weights)
        if not judges_transforms(self._path):
            raise CheckpointError(
                f"the network '{weights}' weighs correspondences, it scores no transforms: give its weights as "
                "filter.weights"
            )

    @cached_property
    def _judge(self) -> MotionJudge:
        from geomoe3d.networks.motion_judge import MotionJudge

        return MotionJudge.from_pretrained(self._path)

    def warm_up(self) -> None:
        """Load the network. Raises CheckpointError: the weights do not fit."""
        self._judge  # noqa: B018

    def identity(self) -> dict[str, Any]:
        """Hash of the weights and of the code that runs them."""
        return {
            "part": NETWORK,
            "weights": file_hash(self._path, CheckpointError),
            "code": source_hash(_RUN_BY),
        }

    def about(self, pair: Pair) -> PairScorer:
        """See `Scorer`."""
        wanted = self._judge.config.compatibility_threshold * pair.voxel_size
        finite = bool(np.isfinite(pair.matched.points).all())
        surfaces = pair.keypoint_surfaces if finite and wanted == pair.inlier_threshold else None
        ask = self._judge.about(pair.matched, voxel_size=pair.voxel_size, surfaces=surfaces)

        def say(transforms: FloatArray) -> list[Opinion]:
            return [Opinion(judged.verdict, judged) for judged in ask(transforms)]

        return say

    def unasked(self, known: Sequence[Score]) -> Opinion:
        """As bad as the worst that it was asked about, or -3."""
        return Opinion(min([expert().network.unseen, *(o.verdict for o in known if isinstance(o, Opinion))]))

    def granted(self) -> Opinion:
        """What it says of such hypotheses in the median."""
        return Opinion(expert().network.granted)
