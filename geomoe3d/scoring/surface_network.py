"""A small network that looks at the points of both clouds, all at once, and says whether a transform is right.

It is asked in the second look, where matches are few: it sees every surface point that both clouds show, where the
network of the matches sees some dozen right ones. Two linear layers per point, what all points, the near ones and the
most telling one hold, three linear layers: in numpy, without torch; `geomoe3d.training.surface_network` trains it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import expert
from geomoe3d.errors import CheckpointError
from geomoe3d.features.learned import DIMENSION
from geomoe3d.runtime.files import file_hash
from geomoe3d.runtime.tensors import read_tensors
from geomoe3d.scoring.base import PairScorer, Scorer, scorer
from geomoe3d.scoring.surface_channels import NUM_CHANNELS, SurfaceChannels, channels_of
from geomoe3d.types import Float32Array, FloatArray

if TYPE_CHECKING:
    from typing_extensions import Self

SURFACE_NETWORK = "surface_network"
WEIGHTS = Path(__file__).parent / "weights" / "surface_network.safetensors"


@dataclass(frozen=True)
class SurfaceVerdict:
    """What the network says of one hypothesis.

    Attributes:
        verdict: logit that it is right.
    """

    verdict: float

    @property
    def factor(self) -> float:
        """exp(weight x verdict), the verdict bounded; see `expert.surface_network`."""
        known = expert().surface_network
        return float(np.exp(known.weight * np.clip(self.verdict, -known.most, known.most)))


@scorer(SURFACE_NETWORK)
class SurfaceNetworkScorer(Scorer):
    """The network as scorer; says nothing of clouds without features of the learned descriptor.

    Args:
        weights: a .safetensors file that `geomoe3d.training.surface_network` wrote; None takes what ships.

    Raises:
        CheckpointError: the file is missing, damaged, or holds another network.
    """

    has_margin = True

    def __init__(self, weights: str | None = None) -> None:
        self._path = WEIGHTS if weights is None else Path(weights)

    @classmethod
    def from_config(cls, config: Any) -> Self:
        """With the weights that the option ``weights`` names, or those that ship with the package."""
        return cls(config.options.get("weights"))

    def warm_up(self) -> None:
        """Load the network."""
        load_tensors(self._path)

    def identity(self) -> dict[str, Any]:
        """With the hash of the weights."""
        return {**super().identity(), "weights": file_hash(self._path, CheckpointError)}

    def about(self, pair: Pair) -> PairScorer:
        """See `Scorer`."""
        if any(c.features is None or c.features.shape[1] != DIMENSION for c in pair.clouds):
            return lambda transforms: []
        tensors, channels = load_tensors(self._path), SurfaceChannels(pair)

        def say(transforms: FloatArray) -> list[SurfaceVerdict]:
            return [SurfaceVerdict(float(x)) for x in logits(tensors, channels_of(channels(transforms)))]

        return say


def logits(tensors: dict[str, Float32Array], channels: Float32Array) -> Float32Array:
    """(K,) logits for channels (K, 2, N, `NUM_CHANNELS`); the same whichever cloud comes first."""
    # The channel that says how near a point has come.
    near = channels[..., 1, None]
    x = (channels - tensors["mean"]) / tensors["std"]
    held = np.maximum(_linear(tensors, "point.2", np.maximum(_linear(tensors, "point.0", x), 0)), 0)
    # Fewer near ones than 2 % of all points are no sample.
    floor = 0.02 * x.shape[2]
    pooled = np.concatenate(
        [held.mean(2), (held * near).sum(2) / (near.sum(2) + floor), held.max(2), x.mean(2)], axis=-1
    ).mean(1)
    found = np.maximum(_linear(tensors, "head.0", pooled), 0)
    found = np.maximum(_linear(tensors, "head.3", found), 0)
    verdicts: Float32Array = _linear(tensors, "head.5", found)[:, 0]
    return verdicts


def _linear(tensors: dict[str, Float32Array], name: str, x: Float32Array) -> Float32Array:
    found: Float32Array = x @ tensors[f"{name}.weight"].T + tensors[f"{name}.bias"]
    return found


def load_tensors(path: Path) -> dict[str, Float32Array]:
    """The tensors of a weight file by name, float32. Raises CheckpointError: no such file, or it is none of
    this network's."""
    return read_tensors(path, "the surface network", "point.0.weight", (None, NUM_CHANNELS))
