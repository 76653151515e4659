"""The network of the learned descriptor in torch, to be trained; `geomoe3d.features.learned` evaluates it in
numpy.

Both take the same levels, neighbours and relations from `geomoe3d.features.pyramid`, and the tensors have the
same names. Training needs features at a few hundred points of a cloud only, hence ``queries``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from geomoe3d.features.learned import LEARNED
from geomoe3d.features.pyramid import NUM_RELATIONS
from geomoe3d.training.descriptor_views import LOOKS, View


class Look(nn.Module):
    """A point looks at its neighbours: largest and mean of what each shows it join what it holds."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.lie = nn.Linear(NUM_RELATIONS, width)
        self.there = nn.Linear(width, width, bias=False)
        self.here = nn.Linear(width, width, bias=False)
        self.out = nn.Sequential(
            nn.Linear(3 * width, width), nn.LayerNorm(width), nn.ReLU(), nn.Linear(width, width)
        )

    def forward(self, held: Tensor, of_held: Tensor, rows: Tensor, lie: Tensor) -> Tensor:
        """(m, width) of ``held`` (m, width), what the other level holds, and the neighbours."""
        seen = torch.relu(self.lie(lie) + self.there(of_held)[rows] + self.here(held)[:, None])
        joined = torch.cat([seen.max(1).values, seen.mean(1), held], 1)
        found: Tensor = held + self.out(joined)
        return found


class DescriptorNetwork(nn.Module):
    """FPFH on three grids to features of 32 numbers and length 1."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        fpfh = 33
        embed = [_mlp(inputs, width, width) for inputs in (fpfh, 2 * fpfh, 2 * fpfh)]
        self.embed = nn.ModuleList(embed)
        for name in LOOKS:
            self.add_module(name, Look(width))
        self.head = _mlp(3 * width, 2 * width, LEARNED)
        with torch.no_grad():
            for layers in embed:
                # FPFH of length 1 is small beside the biases a layer starts with.
                next(layers.parameters()).mul_(4.0)

    def forward(self, view: View) -> Tensor:
        """(q, 32) features of the queries."""
        held = [embed(given) for embed, given in zip(self.embed, view.given, strict=True)]
        own = held[0]
        seen = []
        for name, (at, of) in LOOKS.items():
            held[at] = self.get_submodule(name)(held[at], held[of], view.rows[name], view.lie[name])
            seen.append(held[at])
        return nn.functional.normalize(self.head(torch.cat([own, seen[-2], seen[-1]], 1)), dim=1)


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))
