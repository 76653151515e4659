"""A GeoMoE that sees correspondences under given motions: how sure of each, and which rows are inliers.

Cost at N = 1000 on one core: about 10 ms, and 5 ms per motion; motions are judged side by side on more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch

from geomoe3d.clouds.keypoints import KeypointSurfaces
from geomoe3d.errors import CheckpointError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.folded import FoldedGeoMoE, FoldedOutput
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.inference import Insight, finite_part, run_several
from geomoe3d.networks.inputs import MIN_CORRESPONDENCES, MotionInputs
from geomoe3d.networks.one_thread import helper_keeps_to_one_torch_thread, single_torch_thread
from geomoe3d.networks.pretrained import WeightCard, load_pretrained
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import Correspondences, FilterOutput, FloatArray, IntArray

_PARTS = 2  # of a lot, side by side; for any number of threads: last bits depend on how many share a batch


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
    """A network that judges motions.

    Args:
        model: trained with the channels ``aligned``; its weights are copied.
        card: what it is, or None.
        device: where it runs.

    Raises:
        CheckpointError: a network that judges no motions.
    """

    def __init__(
        self, model: GeoMoE, card: WeightCard | None = None, device: str | torch.device = "cpu"
    ) -> None:
        if not model.config.judges_motions:
            raise CheckpointError(
                "this network judges no transforms, it is an outlier filter: give its weights as filter.weights"
            )
        self.config = model.config
        self.card = card
        self.device = torch.device(device)
        self._network = FoldedGeoMoE(model.to(self.device).eval())

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, device: str | torch.device = "cpu") -> MotionJudge:
        """Load a .safetensors file with its card, or weights that ship with the package.

        Raises:
            CheckpointError: see `geomoe3d.networks.pretrained.load_pretrained`.
        """
        model, card = load_pretrained(name_or_path)
        return cls(model, card, device)

    @single_blas_thread()
    @single_torch_thread()
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
        if len(seen) >= MIN_CORRESPONDENCES:
            views = part.viewpoints or (None, None)
            inputs = MotionInputs(part.points, views, voxel_size, self.config, surfaces)
        return PairJudge(self._network, self.config, self.device, inputs, seen, len(correspondences))


class PairJudge:
    """What the network says of motions of one pair's correspondences; see `MotionJudge.about`."""

    def __init__(
        self,
        network: FoldedGeoMoE,
        config: NetworkConfig,
        device: torch.device,
        inputs: MotionInputs | None,
        seen: IntArray,
        num_rows: int,
    ) -> None:
        self._network, self._config, self._device = network, config, device
        self._inputs, self._seen, self._num_rows = inputs, seen, num_rows

    @single_blas_thread()
    @single_torch_thread()
    def __call__(self, motions: FloatArray) -> list[Judged]:
        """Judge motions, several at a time where there are threads.

        Args:
            motions: (K, 4, 4) p_target = R p_source + t, local coordinates.

        Returns:
            One per motion, in order; none where fewer than 3 rows are finite.
        """
        if self._inputs is None or len(motions) == 0:
            return []
        parts = np.array_split(motions, min(_PARTS, len(motions)))
        return [judged for part in each(self._judge, parts) for judged in part]

    def _judge(self, motions: FloatArray) -> list[Judged]:
        helper_keeps_to_one_torch_thread()
        assert self._inputs is not None
        outputs = run_several(self._network, self._inputs.under(motions), self._device)
        return [
            Judged(float(out.verdict), partial(self._output, out))
            for out in outputs
            if out.verdict is not None
        ]

    def _output(self, out: FoldedOutput) -> FilterOutput:
        insight = Insight.blind(self._num_rows, self._config.num_layers)
        insight.fill(self._seen, out)
        return insight.output(self._config)
