"""What g2o and TUM files are made of: quaternions and information on the right, by their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform, project_to_so3
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.formats import quaternion, right_information


def test_quaternions_and_right_information_against_their_definitions():
    for k in range(30):
        R = Rotation.random(random_state=k).as_matrix()
        q = quaternion(R)
        assert q[3] >= 0
        assert np.abs(Rotation.from_quat(q).as_matrix() - R).max() < 1e-12
    rng = np.random.default_rng(0)
    L = rng.normal(size=(6, 6))
    T = make_transform(Rotation.random(random_state=1).as_matrix(), rng.normal(size=3))
    one = Edge(1, 0, T, 0.9, L @ L.T)
    small = 1e-6 * rng.normal(size=6)  # on the right: translation, half turn
    moved = T @ make_transform(Rotation.from_rotvec(2 * small[3:]).as_matrix(), small[:3])
    D = moved @ inverse(T)  # the same on the left
    left = np.concatenate([Rotation.from_matrix(project_to_so3(D[:3, :3])).as_rotvec(), D[:3, 3]])
    expected = left @ one.information @ left
    assert small @ right_information(one) @ small == pytest.approx(expected, rel=1e-4)
