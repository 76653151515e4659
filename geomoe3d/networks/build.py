"""From a configuration to its network."""

from __future__ import annotations

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.base import CorrespondenceNetwork
from geomoe3d.networks.dematch import DeMatch
from geomoe3d.networks.demo import DeMo
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.oanet import OANet
from geomoe3d.networks.pointcn import PointCNNetwork
from geomoe3d.networks.pointdsc import PointDSC
from geomoe3d.networks.umatch import UMatch

Network = GeoMoE | CorrespondenceNetwork
"""What is trained, saved, loaded and run."""

_KINDS: dict[str, type[GeoMoE] | type[CorrespondenceNetwork]] = {
    "geomoe": GeoMoE,
    "pointcn": PointCNNetwork,
    "oanet": OANet,
    "umatch": UMatch,
    "dematch": DeMatch,
    "demo": DeMo,
    "pointdsc": PointDSC,
}


def build_network(config: NetworkConfig) -> Network:
    """The network of a configuration's ``kind``, with random weights."""
    return _KINDS[config.kind](config)
