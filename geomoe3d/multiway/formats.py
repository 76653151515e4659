"""Poses and graphs in the formats that other tools read: TUM, KITTI and g2o text.

TUM and KITTI hold T_reference_scan in file coordinates: p_reference = R p_scan + t. g2o holds local
coordinates (file coordinates minus each scan's origin), because its consumers compute with them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomoe3d.multiway.edges import Edge, source_information
from geomoe3d.types import FloatArray


def tum_text(names: Sequence[str], numbers: Sequence[int], poses: Sequence[FloatArray]) -> str:
    """``number tx ty tz qx qy qz qw`` per scan; in place of a time, the scan's place in the input."""
    lines = ["# scan tx ty tz qx qy qz qw   (p_reference = R p_scan + t)"]
    for name, number, T in zip(names, numbers, poses, strict=True):
        values = " ".join(f"{value:.17g}" for value in (*T[:3, 3], *quaternion(T[:3, :3])))
        lines += [f"# {' '.join(name.split())}", f"{number} {values}"]
    return "\n".join(lines) + "\n"


def kitti_text(poses: Sequence[FloatArray]) -> str:
    """The upper three rows of every pose in one line, in the order of the scans."""
    return "".join(" ".join(f"{value:.17g}" for value in T[:3].ravel()) + "\n" for T in poses)


def g2o_text(poses: dict[int, FloatArray], edges: Sequence[Edge], *, half_turns: bool = True) -> str:
    """``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT`` lines; the first vertex is fixed.

    An edge i j of g2o measures X_i^-1 X_j, which is T_target_source with i the target and j the source. Its
    information belongs to a small motion on the right, [translation, vector part of the quaternion], or with
    ``half_turns`` False, as GTSAM reads it, [translation, turn].
    """
    lines = []
    for scan in sorted(poses):
        T = poses[scan]
        lines.append(f"VERTEX_SE3:QUAT {scan} {_seven(T)}")
    lines.append(f"FIX {min(poses)}")
    for edge in edges:
        information = right_information(edge, half_turns=half_turns)
        upper = " ".join(f"{information[r, c]:.10g}" for r in range(6) for c in range(r, 6))
        lines.append(f"EDGE_SE3:QUAT {edge.target} {edge.source} {_seven(edge.T_target_source)} {upper}")
    return "\n".join(lines) + "\n"


def right_information(edge: Edge, *, half_turns: bool = True) -> FloatArray:
    """(6, 6) information of an edge in the order [translation, turn], motion on the right.

    g2o counts a turn by the vector part of a quaternion, half of it. GTSAM reads the same file in full turns:
    what is meant for g2o would make rotations weigh four times as much there.
    """
    scale = np.diag([2.0 if half_turns else 1.0] * 3 + [1.0] * 3)
    order = [3, 4, 5, 0, 1, 2]
    information: FloatArray = (scale @ source_information(edge) @ scale)[np.ix_(order, order)]
    return information


def quaternion(R: FloatArray) -> FloatArray:
    """Unit quaternion (x, y, z, w), w >= 0, of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    q: FloatArray = Rotation.from_matrix(R).as_quat(canonical=True)
    return q


def _seven(T: FloatArray) -> str:
    return " ".join(f"{value:.17g}" for value in (*T[:3, 3], *quaternion(T[:3, :3])))
