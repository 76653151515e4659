"""Nearest neighbours of correspondences in a space of a few dimensions, each one its own first neighbour.

On the CPU a k-d tree (about N log N for such spaces), which needs no torch; on other devices brute force in
chunks of rows, so that memory stays linear in N.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.types import IntArray

if TYPE_CHECKING:
    from torch import Tensor


def nearest_rows(values: NDArray[Any], num_neighbors: int, *, threads: int = 1) -> IntArray:
    """The nearest rows of each row, Euclidean.

    Args:
        values: (N, C) float.
        num_neighbors: K, itself included.
        threads: of the search.

    Returns:
        (N, K), column 0 the row itself. With fewer than K rows the rest repeats the row itself.
    """
    from scipy.spatial import cKDTree

    points = values.astype(np.float64)
    wanted = list(range(1, min(num_neighbors, len(points)) + 1))
    index = np.asarray(cKDTree(points).query(points, wanted, workers=threads)[1])
    return _itself_first(index, num_neighbors)


def nearest_neighbors(values: Tensor, num_neighbors: int) -> Tensor:
    """`nearest_rows` of a tensor (N, C), on its device."""
    import torch

    if values.device.type == "cpu":
        threads = torch.get_num_threads()
        return torch.from_numpy(nearest_rows(values.detach().numpy(), num_neighbors, threads=threads))
    rows = max(1, 2**24 // len(values))  # entries of the matrix at a time
    parts = [
        torch.cdist(part, values, compute_mode="donot_use_mm_for_euclid_dist")
        .topk(min(num_neighbors, len(values)), dim=1, largest=False)
        .indices
        for part in torch.split(values, rows)
    ]
    found = _itself_first(torch.cat(parts).cpu().numpy(), num_neighbors)
    return torch.from_numpy(found).to(values.device)


def neighbors_in_batch(values: Tensor, num_neighbors: int) -> Tensor:
    """Nearest rows (B, N, K) of each of (B, N, C), N >= K, the row itself first; brute force on any device."""
    import torch

    distance = torch.cdist(values, values, compute_mode="donot_use_mm_for_euclid_dist")
    distance.diagonal(dim1=1, dim2=2).fill_(-1)
    return distance.topk(num_neighbors, dim=2, largest=False).indices


def _itself_first(index: NDArray[Any], num_neighbors: int) -> IntArray:
    """Neighbours (N, k <= K) with the row itself in front, filled up to (N, K); a duplicate may come before it."""
    index = index.astype(np.int64)
    rows = np.arange(len(index))[:, None]
    place = (index == rows).argmax(axis=1, keepdims=True)
    np.put_along_axis(index, place, index[:, :1], axis=1)
    filled = np.repeat(rows, num_neighbors - index.shape[1], axis=1)
    return np.hstack([rows, index[:, 1:], filled])
