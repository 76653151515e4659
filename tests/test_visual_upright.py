"""Upright axes follow the walls of a room, however it was turned or recorded."""

from __future__ import annotations

import numpy as np
import pytest
from registration_views import UTM, box_room
from scipy.spatial.transform import Rotation

from geomoe3d.visual.upright import upright_axes


@pytest.mark.parametrize("yaw_deg", [0.0, 17.0, 44.0, -30.0])
def test_upright_axes_follow_the_walls(yaw_deg):
    turn = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    points = box_room(6000, 5) @ turn.T + UTM
    axes, words = upright_axes(points, np.random.default_rng(0))
    assert words == "z up"
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert axes[2] @ [0, 0, 1] > np.cos(np.radians(1.0))
    wall = abs(axes[0] @ turn[:, 0])  # 1 or 0: along one of the two wall directions
    assert min(1.0 - wall, wall) < np.sin(np.radians(2.0))


def test_upright_axes_of_a_tilted_camera_and_of_a_y_up_file():
    room = box_room(8000, 6)
    tilt = np.radians(25.0)
    down, forward = np.array([0, -np.sin(tilt), -np.cos(tilt)]), np.array([0, np.cos(tilt), -np.sin(tilt)])
    camera = np.stack([[1.0, 0, 0], down, forward])  # rows: the camera's x, y (down), z (forward)
    eye = np.array([3.0, -3.5, 3.0])
    seen = (room - eye) @ camera.T
    axes, words = upright_axes(seen, np.random.default_rng(0))
    assert words == "camera, y down"
    assert axes[2] @ camera[:, 2] > np.cos(np.radians(1.5))  # the room's z axis in the camera's frame
    to_y_up = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    axes, words = upright_axes((room - [3, 2.2, 0]) @ to_y_up.T, np.random.default_rng(0))
    assert words == "y up"
    assert axes[2] @ [0, 1, 0] > np.cos(np.radians(1.0))
