"""A trained GeoMoE that weighs correspondences: outlier rejection as in the paper.

Weights are loaded once and folded for inference; calls share nothing and draw nothing at random. Rows with
a NaN or infinite coordinate get weight 0. Cost: linear in N, about 30 ms at N = 1000 on two idle cores
beside the inputs that the network asks for. A network that scores transforms is a scorer
(`geomoe3d.scoring.network`), no filter.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from numpy.typing import NDArray

from geomoe3d.config import FilterConfig
from geomoe3d.errors import CheckpointError, ConfigError, DependencyError
from geomoe3d.filters.base import OutlierFilter, outlier_filter
from geomoe3d.runtime.sources import source_hash
from geomoe3d.types import Correspondences, FilterOutput

if TYPE_CHECKING:
    from typing_extensions import Self

    from geomoe3d.networks.geomoe import GeoMoE
    from geomoe3d.networks.inference import Insight
    from geomoe3d.networks.weight_files import WeightCard

_MATCHING_CHANNELS = ("feature_distance", "ratio", "mutual")


@outlier_filter("geomoe")
class GeoMoEFilter(OutlierFilter):
    """A network as outlier filter.

    Args:
        model: trained, not one that scores transforms; its weights are copied.
        card: what it is, or None.

    Raises:
        CheckpointError: a network that scores transforms.
    """

    takes_weights: ClassVar[bool] = True

    def __init__(self, model: GeoMoE, card: WeightCard | None = None) -> None:
        from geomoe3d.networks.folded import FoldedGeoMoE

        if model.config.judges_motions:
            raise CheckpointError(
                "this network scores transforms, it is no filter; give its weights as scoring.weights"
            )
        self.config = model.config
        self.card = card
        self.needs = frozenset(_MATCHING_CHANNELS) & frozenset(model.config.extra_channels)
        self._network = FoldedGeoMoE.of(model)

    @classmethod
    def from_config(cls, config: FilterConfig) -> Self:
        """With the weights that the configuration names.

        Raises:
            ConfigError: it names none.
            CheckpointError: not found, or they do not fit.
            DependencyError: PyTorch is not installed.
        """
        if config.weights is None:
            raise ConfigError(
                "the filter 'geomoe' needs trained weights (filter.weights); the network that ships with "
                "geomoe3d scores transforms instead, which is the default (scoring.scorers)"
            )
        return cls.from_pretrained(config.weights)

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path) -> Self:
        """Load a .safetensors file with its card. Raises CheckpointError: see
        `geomoe3d.networks.pretrained.load_pretrained`; DependencyError: PyTorch is not installed."""
        try:
            from geomoe3d.networks.pretrained import load_pretrained
        except ImportError as error:
            raise DependencyError(
                f"the filter 'geomoe' needs PyTorch ({error}); `geomoe3d doctor` gives the command that installs "
                "it, or use --filter none"
            ) from error
        return cls(*load_pretrained(name_or_path))

    def identity(self) -> dict[str, Any]:
        """Architecture, hash of the weights, and hash of the code."""
        return {
            "part": "geomoe",
            "architecture": self.config.model_dump(mode="json"),
            "weights": None if self.card is None else self.card.sha256,
            "code": source_hash(type(self).__module__),
        }

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """Weigh correspondences; see `OutlierFilter`.

        Returns:
            See `Insight.output`. With fewer than 3 finite rows there is nothing to go by: all weights 0.

        Raises:
            InputError: the network was trained with a channel that these correspondences lack.
        """
        return self.look(correspondences, voxel_size=voxel_size).output(self.config)

    def look(self, correspondences: Correspondences, *, voxel_size: float) -> Insight:
        """What all layers say, sub-fields and experts, for drawing."""
        from geomoe3d.networks.config import FIXED
        from geomoe3d.networks.inference import Insight, finite_part
        from geomoe3d.networks.inputs import pair_input

        result = Insight.blind(len(correspondences), self.config.num_layers)
        seen, part = finite_part(correspondences)
        if len(seen) < FIXED.min_correspondences:
            return result
        given: dict[str, NDArray[Any] | None] = {name: getattr(part, name) for name in sorted(self.needs)}
        inputs = pair_input(part.points, voxel_size, self.config, **given)
        channels = None if inputs.channels is None else inputs.channels.numpy()
        result.fill(seen, self._network(inputs.coordinates.numpy(), channels, inputs.neighbors.numpy()))
        return result
