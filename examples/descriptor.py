"""A descriptor of your own: how the points around a point spread, at two radii.

    geomoe3d register source.ply target.ply --descriptor examples/descriptor.py:Spread
    geomoe3d register source.ply target.ply --descriptor examples/descriptor.py:Spread \\
        --set descriptor.options.radii=[3,8]
"""

import numpy as np
from scipy.spatial import cKDTree

from geomoe3d.features.base import Descriptor


class Spread(Descriptor):
    """Eigenvalues of the neighbourhood and the angles of its normals, which do not change when the cloud turns.

    Args:
        radii: neighbourhoods, in voxels.
    """

    needs_normals = True

    def __init__(self, radii=(3.0, 6.0)):
        self.radii = [float(radius) for radius in radii]
        self.dimension = 7 * len(self.radii)

    def __call__(self, cloud):
        tree = cKDTree(cloud.points)
        parts = []
        for radius in self.radii:
            rows = []
            for point, near in enumerate(tree.query_ball_point(cloud.points, radius * cloud.voxel_size)):
                away = cloud.points[near] - cloud.points[near].mean(0)
                spread = np.sqrt(np.linalg.eigvalsh(away.T @ away / len(near)).clip(0))
                cosines = cloud.normals[near] @ cloud.normals[point]
                rows.append(
                    [*spread / (radius * cloud.voxel_size), *np.quantile(cosines, (0.1, 0.3, 0.5, 0.7))]
                )
            parts.append(np.array(rows))
        features = np.hstack(parts).astype(np.float32)
        return features / np.linalg.norm(features, axis=1, keepdims=True)
