"""What the descriptor's network is shown: fragments on three grids, and views of many of them in one batch.

`Fragment` is made from bare points in torch, `View.of` from what registration has; both hold the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from geomoe3d.config import DescriptorConfig, PreparationConfig
from geomoe3d.features.learned import NUM_NEIGHBORS
from geomoe3d.features.pyramid import FACTORS, Level, nearest, relations
from geomoe3d.training.torch_surface import fpfh, nearest_points, plane_normals
from geomoe3d.types import IntArray

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
_TINY = 1e-6


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

    @classmethod
    def of(cls, levels: tuple[Level, ...], queries: IntArray) -> View:
        """Of a pyramid, with features wanted at these rows of its finest level."""
        fine, middle, coarse = levels
        asked = (fine.take(queries), middle, coarse)
        given = [torch.from_numpy(asked[0].features)]
        for level in (middle, coarse):
            both = torch.from_numpy(fine.features[level.rows]), torch.from_numpy(level.features)
            given.append(torch.cat(both, 1))
        rows, lie = {}, {}
        for name, (at, of) in LOOKS.items():
            _, near = nearest(asked[at], levels[of], NUM_NEIGHBORS)
            rows[name] = torch.from_numpy(near)
            lie[name] = torch.from_numpy(relations(asked[at], levels[of], near))
        return cls(tuple(given), rows, lie)


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
    def build(cls, points: Tensor, sensor: Tensor, corner: Tensor, turn: Tensor) -> Fragment | None:
        """From bare points; None where the coarsest grid is too small to look around in.

        Args:
            points: (n, 3) float32, in voxels.
            sensor: (3,) where it stood, in voxels.
            corner, turn: (3,) and (3, 3), how the coarser grids lie.
        """
        preparation, describe = PreparationConfig(), DescriptorConfig()
        near = nearest_points(points, points, describe.neighbors)
        few = near[0][:, : preparation.normal_neighbors], near[1][:, : preparation.normal_neighbors]
        normals = plane_normals(points, preparation.normal_radius, few)
        normals = torch.where(((sensor - points) * normals).sum(1, keepdim=True) < 0, -normals, normals)
        own = fpfh(points, normals, describe.radius, near)
        grids = []
        for edge in FACTORS:
            rows = torch.arange(len(points), device=points.device)
            if edge > 1:
                rows = first_of_voxels(points @ turn.T + corner, edge)
                if len(rows) < NUM_NEIGHBORS:
                    return None
            some = points[rows], normals[rows]
            given = own[rows]
            if edge > 1:
                near = nearest_points(some[0], some[0], describe.neighbors)
                wide = fpfh(*some, describe.radius * edge, near)
                given = torch.cat([given, wide], 1)
            grids.append(Grid(*some, given.half(), edge))
        fine, middle, coarse = grids
        looked = {
            name: nearest_points(grids[at].points, grids[of].points, NUM_NEIGHBORS)[1].int()
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
    distance = squared.sqrt() + _TINY
    triple = (here * torch.linalg.cross(way, there)).sum(2)
    found = [distance, over_here, over_there, (there * here).sum(2), triple]
    return torch.stack([*found, over_here / distance, over_there / distance, squared], 2)


def first_of_voxels(points: Tensor, edge: float) -> Tensor:
    """Rows of the first point in every voxel of a grid, rising."""
    _, which = torch.unique((points / edge).floor().long(), dim=0, return_inverse=True)
    first = torch.full((int(which.max()) + 1,), len(points), device=points.device)
    rows = torch.arange(len(points), device=points.device)
    return first.scatter_reduce(0, which, rows, "amin").sort().values
