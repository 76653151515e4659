"""Essential matrices: exact on clean matches, with a right gradient, finite and refused where nothing is fixed."""

from __future__ import annotations

import pytest
import torch

from geomoe3d.geometry.essential import (
    decompose,
    depths,
    essential_of,
    pose_errors_deg,
    smallest_direction,
    symmetric_distance,
    virtual_matches,
    weighted_eight_point,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def scene(num=40, seed=0, planar=False):
    """Clean matches (1, N, 4) of points before both cameras, and the pose (1, 4, 4)."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(1, num, 3, generator=generator, dtype=torch.float64) * 2 - 1
    if planar:
        points[..., 2] = 0.3 * points[..., 0]
    points[..., 2] += 4
    axis = torch.tensor([0.1, 1.0, 0.2], dtype=torch.float64) * 0.4
    K = torch.tensor([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, :3, :3] = torch.linalg.matrix_exp(K)
    T[0, :3, 3] = (
        torch.tensor([-0.8, 0.1, 0.6]) - (T[0, :3, :3] - torch.eye(3)) @ torch.tensor([0.0, 0, 4]).double()
    )
    moved = points @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
    assert moved[..., 2].min() > 0
    return torch.cat([points[..., :2] / points[..., 2:], moved[..., :2] / moved[..., 2:]], -1), T


def test_eight_point_finds_the_pose_of_clean_matches_and_ignores_what_weighs_nothing():
    matches, T = scene()
    matches = torch.cat([matches, torch.full((1, 3, 4), torch.nan), torch.rand(1, 20, 4)], dim=1)
    weights = torch.cat([torch.rand(1, 43) + 0.1, torch.zeros(1, 20)], dim=1).double()
    fit = weighted_eight_point(matches, weights)
    assert bool(fit.valid)
    E = essential_of(T)
    assert min((fit.E - E).norm(), (fit.E + E).norm()) < 1e-6
    found = decompose(fit.E, matches.nan_to_num(), weights)
    assert max(*pose_errors_deg(found, T)) < 1e-5
    z0, _ = depths(found, matches[:, :40])
    assert bool((z0 > 0).all())


@pytest.mark.parametrize("kind", ["zero weights", "seven matches", "one point", "plane", "nothing turned"])
def test_degenerate_matches_are_refused_and_their_gradient_is_finite(kind):
    matches, _ = scene(planar=kind == "plane")
    weights = torch.ones(1, 40, dtype=torch.float64)
    if kind == "zero weights":
        weights = weights * 0
    elif kind == "seven matches":
        weights[:, 7:] = 0
    elif kind == "one point":
        matches = matches[:, :1].expand(1, 40, 4)
    elif kind == "nothing turned":
        matches = torch.cat([matches[..., :2], matches[..., :2]], dim=-1)
    weights.requires_grad_()
    fit = weighted_eight_point(matches, weights)
    assert not bool(fit.valid)
    assert bool(fit.E.isfinite().all())
    fit.E.square().sum().add(fit.E[..., 0, 1].sum()).backward()
    assert bool(weights.grad.isfinite().all())


def test_the_gradient_is_that_of_differences():
    matrix = torch.randn(2, 5, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def projector(A):
        v, _ = smallest_direction(A @ A.transpose(1, 2))
        return v[..., :, None] * v[..., None, :]  # of either sign

    assert torch.autograd.gradcheck(projector, matrix.requires_grad_(), atol=1e-6)


def test_virtual_matches_fulfil_the_equation_and_the_distance_is_that_of_lines():
    _, T = scene()
    E = essential_of(T)
    virtual = virtual_matches(E, 6)
    assert virtual.shape == (1, 72, 4)
    assert symmetric_distance(E, virtual).max() < 1e-20
    # Sideways motion: epipolar lines are rows; one unit off in y is one unit in either image.
    sideways = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    found = symmetric_distance(sideways, torch.tensor([[0.3, 0.5, -0.7, 0.5], [0.0, 0.0, 0.4, 1.0]]))
    torch.testing.assert_close(found, torch.tensor([0.0, 2.0]))


def test_angles_of_hand_made_poses():
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, :3, 3] = torch.tensor([1.0, 0, 0])
    other = T.clone()
    other[1, :3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    other[1, :3, 3] = torch.tensor([0.0, 5, 0])
    other[2, :3, 3] = torch.tensor([-2.0, 0, 0])  # the other way along the same line
    rotation, translation = pose_errors_deg(other, T)
    torch.testing.assert_close(rotation, torch.tensor([0.0, 90, 0]).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(translation, torch.tensor([0.0, 90, 0]).double(), atol=1e-5, rtol=0)
