"""Nearest neighbours of correspondences in a space of a few dimensions, each one its own first neighbour.

On the CPU a k-d tree (about N log N for such spaces); on other devices brute force in chunks of rows, so
that memory stays linear in N.
"""

from __future__ import annotations

import torch
from torch import Tensor

_CHUNK_ENTRIES = 1 << 24


def nearest_neighbors(values: Tensor, num_neighbors: int) -> Tensor:
    """The nearest rows of each row, Euclidean.

    Args:
        values: (N, C) float.
        num_neighbors: K, itself included.

    Returns:
        (N, K) int64, column 0 the row itself. With fewer than K rows the rest repeats the row itself.
    """
    num = len(values)
    found = min(num_neighbors, num)
    index = _by_tree(values, found) if values.device.type == "cpu" else _by_chunks(values, found)
    rows = torch.arange(num, device=values.device)[:, None]
    if found > 1:  # a duplicate may come before the row itself: put the row first
        place = (index == rows).float().argmax(dim=1, keepdim=True)
        index = index.scatter(1, place, index[:, :1])
    index = torch.cat([rows, index[:, 1:]], dim=1)
    return torch.cat([index, rows.expand(num, num_neighbors - found)], dim=1)


def _by_tree(values: Tensor, num_neighbors: int) -> Tensor:
    from scipy.spatial import cKDTree

    points = values.detach().double().numpy()
    _, index = cKDTree(points).query(
        points, list(range(1, num_neighbors + 1)), workers=torch.get_num_threads()
    )
    return torch.from_numpy(index).long()


def _by_chunks(values: Tensor, num_neighbors: int) -> Tensor:
    rows = max(1, _CHUNK_ENTRIES // len(values))
    parts = [
        torch.cdist(part, values, compute_mode="donot_use_mm_for_euclid_dist")
        .topk(num_neighbors, dim=1, largest=False)
        .indices
        for part in torch.split(values, rows)
    ]
    return torch.cat(parts)
