"""The baselines of the paper, trained, as outlier filters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from geomoe3d.config import FilterConfig
from geomoe3d.errors import CheckpointError, DependencyError
from geomoe3d.filters.base import OutlierFilter, outlier_filter
from geomoe3d.runtime.sources import source_hash
from geomoe3d.types import Correspondences, FilterOutput

if TYPE_CHECKING:
    from typing_extensions import Self

    from geomoe3d.networks.build import Network
    from geomoe3d.networks.weight_files import WeightCard

_RUN_BY = "geomoe3d.networks.plain"


@outlier_filter("pointcn", "oanet", "umatch", "dematch", "demo", "pointdsc")
class NetworkFilter(OutlierFilter):
    """Any trained network that weighs correspondences; see `geomoe3d.networks.plain`.

    Args:
        model: trained, not one that scores transforms.
        card: what it is, or None.

    Raises:
        CheckpointError: a network that scores transforms.
    """

    takes_weights: ClassVar[bool] = True

    def __init__(self, model: Network, card: WeightCard | None = None) -> None:
        from geomoe3d.networks.plain import PlainNetwork

        self._weigh, self._card = PlainNetwork(model), card
        self.needs = frozenset({"feature_distance", "ratio", "mutual"} & set(model.config.extra_channels))

    @classmethod
    def from_config(cls, config: FilterConfig) -> Self:
        """With the weights that the configuration names. Raises CheckpointError: none given, not found,
        broken, or of another network; DependencyError: PyTorch is not installed."""
        return cls.from_pretrained(config.name, config.weights)

    @classmethod
    def from_pretrained(cls, kind: str, weights: str | Path | None) -> Self:
        """A network of this kind from a .safetensors file with its card beside it. Raises CheckpointError,
        DependencyError: as `from_config`."""
        if weights is None:
            raise CheckpointError(
                f"no weights of '{kind}' ship with this version; train it with configs/train/paper/{kind}.yaml "
                "and give the file"
            )
        try:
            from geomoe3d.networks.pretrained import load_network
        except ImportError as error:
            raise DependencyError(
                f"the filter '{kind}' needs PyTorch ({error}); `geomoe3d doctor` gives the command that installs it"
            ) from error
        model, card = load_network(weights)
        if model.config.kind != kind:
            raise CheckpointError(f"'{weights}' holds weights of '{model.config.kind}', not of '{kind}'")
        return cls(model, card)

    def identity(self) -> dict[str, Any]:
        """Architecture, hash of the weights, and hash of the code."""
        return {
            "part": self._weigh.config.kind,
            "architecture": self._weigh.config.model_dump(mode="json"),
            "weights": None if self._card is None else self._card.sha256,
            "code": source_hash(_RUN_BY),
        }

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """See `OutlierFilter`. Raises InputError: the network was trained with a channel that these
        correspondences lack."""
        return self._weigh(correspondences, voxel_size=voxel_size)
