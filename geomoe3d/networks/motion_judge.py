"""A GeoMoE that sees correspondences under given motions: how sure of each, and which rows are inliers.

Cost at N = 1000 on one core: about 10 ms, and 5 ms per motion; motions are judged side by side on more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from geomoe3d.clouds.keypoints import KeypointSurfaces
from geomoe3d.errors import CheckpointError
from geomoe3d.networks.config import FIXED
from geomoe3d.networks.folded import FoldedGeoMoE, FoldedOutput
from geomoe3d.networks.inference import Insight, finite_part
from geomoe3d.networks.motion_inputs import MotionInputs
from geomoe3d.networks.weight_files import WeightCard, read_weights
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import Correspondences, FilterOutput, FloatArray, IntArray


class Judged:
    """What the network says under one motion.

    Attributes:
        verdict: logit that the motion is right.
        output: weights of the N correspondences under it, made when asked for.
    """

    def __init__(self, verdict: float, make: Callable[[], FilterOutput]) -> None:
        self.verdict = verdict
        self._make = make

    @cached_property
    def output(self) -> FilterOutput:
        """See the class."""
        return self._make()


class MotionJudge:
    """A network that scores transforms.

    Args:
        network: trained with the channels ``aligned``.
        card: what it is, or None.

    Raises:
        CheckpointError: a network that scores no transforms.
    """

    def __init__(self, network: FoldedGeoMoE, card: WeightCard | None = None) -> None:
        if not network.config.judges_motions:
            raise CheckpointError(
                "this network scores no transforms, it is an outlier filter: give its weights as filter.weights"
            )
        self.config = network.config
        self.card = card
        self._network = network

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path) -> MotionJudge:
        """Load a .safetensors file with its card, or weights that ship with the package. Raises
        CheckpointError: see `geomoe3d.networks.weight_files.read_weights` and `FoldedGeoMoE`."""
        config, tensors, card = read_weights(name_or_path)
        return cls(FoldedGeoMoE(config, tensors), card)

    @single_blas_thread()
    def about(
        self,
        correspondences: Correspondences,
        *,
        voxel_size: float,
        surfaces: KeypointSurfaces | None = None,
    ) -> PairJudge:
        """The judge of one pair's motions.

        Args:
            correspondences: N rows in local coordinates; free space is asked where ``viewpoints`` are given.
            voxel_size: the grid the points came from.
            surfaces: of the finite ones, see `MotionInputs`, where somebody has them already.
        """
        seen, part = finite_part(correspondences)
        inputs = None
        if len(seen) >= FIXED.min_correspondences:
            views = part.viewpoints or (None, None)
            inputs = MotionInputs(part.points, views, voxel_size, self.config, surfaces)
        return PairJudge(self._network, inputs, seen, len(correspondences))


class PairJudge:
    """What the network says of motions of one pair's correspondences; see `MotionJudge.about`."""

    def __init__(
        self, network: FoldedGeoMoE, inputs: MotionInputs | None, seen: IntArray, num_rows: int
    ) -> None:
        self._network, self._inputs, self._seen, self._num_rows = network, inputs, seen, num_rows

    @single_blas_thread()
    def __call__(self, motions: FloatArray) -> list[Judged]:
        """Judge motions, several at a time where there are threads.

        Args:
            motions: (K, 4, 4) p_target = R p_source + t, local coordinates.

        Returns:
            One per motion, in order; none where fewer than 3 rows are finite.
        """
        if self._inputs is None or len(motions) == 0:
            return []
        # Side by side; two for any number of threads, since last bits depend on how many share a batch.
        parts = np.array_split(motions, min(2, len(motions)))
        return [judged for part in each(self._judge, parts) for judged in part]

    def _judge(self, motions: FloatArray) -> list[Judged]:
        inputs = self._inputs
        assert inputs is not None
        outputs = self._network.under_motions(inputs.coordinates, inputs.channels(motions), inputs.neighbors)
        return [Judged(out.verdict, partial(self._output, out)) for out in outputs if out.verdict is not None]

    def _output(self, out: FoldedOutput) -> FilterOutput:
        config = self._network.config
        insight = Insight.blind(self._num_rows, config.num_layers)
        insight.fill(self._seen, out)
        return insight.output(config)
