"""What g2o and TUM files are made of: quaternions and information on the right, by their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform, project_to_so3
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.formats import g2o_text, quaternion, right_information


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


def test_gtsam_weighs_an_edge_as_it_was_measured(tmp_path):
    """What is meant for g2o would weigh a turn four times there."""
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(0)
    T = make_transform(Rotation.random(random_state=1).as_matrix(), rng.normal(size=3))
    L = rng.normal(size=(6, 6))
    edge = Edge(1, 0, T, 0.9, L @ L.T)

    def error(pose, half_turns):
        text = g2o_text({0: np.eye(4), 1: pose}, [edge], half_turns=half_turns)
        (tmp_path / "a.g2o").write_text(text)
        graph, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
        return graph.error(values)

    for _ in range(5):
        off = 1e-3 * rng.normal(size=6)  # on the left: turn, translation
        D = make_transform(Rotation.from_rotvec(off[:3]).as_matrix(), off[3:])
        assert error(D @ T, False) == pytest.approx(off @ edge.information @ off / 2, rel=1e-2)
    turn = make_transform(Rotation.from_rotvec(off[:3]).as_matrix(), np.zeros(3))
    shift = make_transform(np.eye(3), off[3:])
    assert error(T @ turn, True) == pytest.approx(4 * error(T @ turn, False), rel=1e-6)
    assert error(T @ shift, True) == pytest.approx(error(T @ shift, False), rel=1e-6)
