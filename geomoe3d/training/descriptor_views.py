"""What the descriptor's network is shown: fragments on three grids, and views of many of them in one batch.

`Fragment` holds a whole pyramid as tensors on one device, from which views at ever other points are quick to take.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from geomoe3d.features.learned import NUM_NEIGHBORS
from geomoe3d.features.pyramid import FACTORS, Level, nearest

LOOKS = {
    "middle_middle": (1, 1),
    "coarse_middle": (2, 1),
    "coarse_coarse": (2, 2),
    "fine_middle": (0, 1),
    "fine_coarse": (0, 2),
}
"""Which level looks at which, in the order of evaluation."""
# FPFH of normals turned over: the first and the third of its three histograms run backwards.
_TURNED_OVER = torch.cat([torch.arange(11).flip(0), torch.arange(11, 22), torch.arange(22, 33).flip(0)])


@dataclass(frozen=True)
class View:
    """One cloud, or several one after the other, at the points that are asked for.

    Attributes:
        given: of the queries, the middle and the coarse level, what each point begins with.
        rows: by look, (m, k) neighbours.
        lie: by look, (m, k, 8) how they lie.
    """

    given: tuple[Tensor, ...]
    rows: dict[str, Tensor]
    lie: dict[str, Tensor]


@dataclass(frozen=True)
class Grid:
    """One grid of a fragment: m of its points, lengths in voxels; ``edge`` of the grid."""

    points: Tensor
    normals: Tensor
    given: Tensor
    edge: int


@dataclass(frozen=True)
class Fragment:
    """A fragment on three grids, finest first, and by look the rows (m, k) of each point's neighbours."""

    grids: tuple[Grid, Grid, Grid]
    rows: dict[str, Tensor]

    @classmethod
    def of(
        cls, levels: tuple[Level, ...], device: torch.device | str, kept: torch.dtype = torch.half
    ) -> Fragment | None:
        """Of a pyramid; None where its coarsest level is too small to look around in.

        ``kept``: in which precision features are held; half saves a third of the memory.
        """
        if len(levels[-1]) < NUM_NEIGHBORS:
            return None
        grids, own = [], torch.from_numpy(levels[0].features)
        for level in levels:
            given = torch.from_numpy(level.features)
            if level.edge > 1:
                given = torch.cat([own[torch.from_numpy(level.rows)], given], 1)
            points, normals = (torch.from_numpy(x).to(device) for x in (level.points, level.normals))
            grids.append(Grid(points, normals, given.to(device, kept), level.edge))
        fine, middle, coarse = grids
        looked = {
            name: torch.from_numpy(nearest(levels[at], levels[of], NUM_NEIGHBORS)[1]).int().to(device)
            for name, (at, of) in LOOKS.items()
        }
        return cls((fine, middle, coarse), looked)

    def turned_over(self) -> Fragment:
        """With all normals on the other side, as where a guess of the sensor failed."""
        order = _TURNED_OVER.to(self.grids[0].points.device)
        fine, middle, coarse = (
            replace(
                grid,
                normals=-grid.normals,
                given=grid.given.view(len(grid.given), -1, 33)[:, :, order].flatten(1),
            )
            for grid in self.grids
        )
        return Fragment((fine, middle, coarse), self.rows)


def batch_view(fragments: list[Fragment], queries: list[Tensor]) -> View:
    """Views of several fragments, each at its queries (rows of its finest grid), one after the other."""
    asked = [
        (
            Grid(f.grids[0].points[q], f.grids[0].normals[q], f.grids[0].given[q], 1),
            f.grids[1],
            f.grids[2],
        )
        for f, q in zip(fragments, queries, strict=True)
    ]
    together = [
        Grid(
            torch.cat([one[k].points for one in asked]),
            torch.cat([one[k].normals for one in asked]),
            torch.cat([one[k].given for one in asked]),
            edge,
        )
        for k, edge in enumerate(FACTORS)
    ]
    rows, lie = {}, {}
    for name, (at, of) in LOOKS.items():
        start, parts = 0, []
        for one, fragment, query in zip(asked, fragments, queries, strict=True):
            near = fragment.rows[name]
            parts.append((near[query] if at == 0 else near).long() + start)
            start += len(one[of].points)
        rows[name] = torch.cat(parts)
        lie[name] = torch_relations(together[at], together[of], rows[name])
    return View(tuple(grid.given.float() for grid in together), rows, lie)


def torch_relations(at: Grid, of: Grid, rows: Tensor) -> Tensor:
    """`geomoe3d.features.pyramid.relations` in torch."""
    way = (of.points[rows] - at.points[:, None]) / (4 * of.edge)
    here, there = at.normals[:, None].expand_as(way), of.normals[rows]
    squared, over_here, over_there = (way * way).sum(2), (way * here).sum(2), (way * there).sum(2)
    distance = squared.sqrt() + 1e-6
    triple = (here * torch.linalg.cross(way, there)).sum(2)
    found = [distance, over_here, over_there, (there * here).sum(2), triple]
    return torch.stack([*found, over_here / distance, over_there / distance, squared], 2)
