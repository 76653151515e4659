"""PointCN: twelve residual blocks, each correspondence seen alone but for the norms.

Source: Yi et al., Learning to find good correspondences (CVPR 2018), with the pre-activation blocks of later
work.
"""

from __future__ import annotations

from torch import Tensor, nn

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.base import CorrespondenceNetwork
from geomoe3d.networks.blocks import PointCN
from geomoe3d.networks.layers import motion
from geomoe3d.networks.norms import Pointwise


class PointCNNetwork(CorrespondenceNetwork):
    """1x1, ``num_layers`` PointCN blocks, 1x1; 403,457 parameters."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.embedding = Pointwise(config.input_width, config.width)
        self.blocks = nn.ModuleList(PointCN(config.width) for _ in range(config.num_layers))
        self.predict = Pointwise(config.width, 1)

    def verdicts(
        self, coordinates: Tensor, neighbors: Tensor | None, mask: Tensor | None
    ) -> tuple[list[Tensor], Tensor | None]:
        """See `CorrespondenceNetwork.verdicts`: one verdict."""
        field = self.embedding(motion(coordinates, self.config.motion_form).transpose(1, 2))
        for block in self.blocks:
            field = block(field, mask)
        return [self.predict(field)[:, 0]], None
