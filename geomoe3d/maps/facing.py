"""Which way the surfaces of a map face, where no sensor says it: the same way as their neighbours.

A feature needs the sign of the normals, and a merged cloud has none. Between neighbours the sign can be carried
over; whether all of a surface faces one way or the other is left open, and the map is then described from both
sides (`both_sides`). 0.5 s for 100,000 points.
Source: Hoppe et al., SIGGRAPH 1992: signs along the minimum spanning tree of 1 - |n_i . n_j|.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.config import expert
from geomoe3d.runtime.threads import usable_threads
from geomoe3d.types import Float32Array, FloatArray

_BINS = 11  # of each of the three histograms of an FPFH


def facing_alike(points: FloatArray, normals: FloatArray) -> FloatArray:
    """Normals (n, 3) with signs that agree between neighbours, as far as a tree through all points carries them."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
    from scipy.spatial import cKDTree

    n, k = len(points), min(expert().maps.facing_neighbors, len(points) - 1)
    _, near = cKDTree(points).query(points, k=k + 1, workers=usable_threads())
    rows, columns = np.repeat(np.arange(n), k), np.asarray(near)[:, 1:].ravel()
    cosine = np.einsum("ij,ij->i", normals[rows], normals[columns])
    # Nothing may weigh zero: a sparse matrix would not hold it.
    weights = 1.0 - np.abs(cosine) + expert().maps.least_weight
    tree = minimum_spanning_tree(coo_matrix((weights, (rows, columns)), shape=(n, n)).tocsr())
    parent = np.arange(n)
    count, part = connected_components(tree, directed=False)
    for root in np.unique(part, return_index=True)[1] if count < n else ():
        order, before = breadth_first_order(tree, int(root), directed=False, return_predecessors=True)
        parent[order[1:]] = before[order[1:]]
    sign = np.where(np.einsum("ij,ij->i", normals, normals[parent]) < 0, -1.0, 1.0)
    while (parent[parent] != parent).any():  # each step doubles the length of path that is known
        sign, parent = sign * sign[parent], parent[parent]
    return normals * sign[:, None]


def both_sides(features: Float32Array) -> Float32Array:
    """FPFH, or several joined, as if all normals had been turned over.

    Of the three angles between two points' frames two change their sign and one does not (u and v turn over, w does
    not), so the first and the third histogram of each 33 numbers are mirrored.
    """
    blocks = features.reshape(len(features), features.shape[1] // (3 * _BINS), 3, _BINS).copy()
    blocks[:, :, [0, 2]] = blocks[:, :, [0, 2], ::-1]
    turned: Float32Array = blocks.reshape(features.shape)
    return turned
