"""What the network is given: free of units and origins, and, where designed, of rotations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch.utils._python_dispatch import TorchDispatchMode

from geomoe3d.config import build_config
from geomoe3d.errors import ConfigError, InputError, NonFiniteError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.compatibility import compatibility_inputs
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.inputs import BatchInput, PairInput, collate, pair_input

FAITHFUL = NetworkConfig()
STRONGER = NetworkConfig(extra_channels=("compatibility", "hypothesis"), knn_space="compatibility")
BLIND = NetworkConfig(
    extra_channels=("compatibility", "hypothesis"), knn_space="compatibility", motion_form="none"
)


pytestmark = pytest.mark.usefixtures("one_thread")


def scene(num: int = 120, inliers: int = 40, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Correspondences in metres of which the first rows are right, and their motion."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    source = rng.uniform(-1.5, 1.5, (num, 3))
    target = rng.uniform(-1.5, 1.5, (num, 3)) + T[:3, 3]
    target[:inliers] = source[:inliers] @ T[:3, :3].T + T[:3, 3] + rng.normal(0, 0.01, (inliers, 3))
    return np.concatenate([source, target], axis=1), T


def assert_same(a: PairInput, b: PairInput, atol: float = 1e-4) -> None:
    torch.testing.assert_close(a.coordinates, b.coordinates, atol=atol, rtol=0)
    assert torch.equal(a.neighbors, b.neighbors)
    if a.channels is not None:
        torch.testing.assert_close(a.channels, b.channels, atol=1e-3, rtol=0)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.001, 1000), st.integers(0, 5))
@pytest.mark.parametrize("config", [FAITHFUL, STRONGER])
def test_unit_and_origins_do_not_matter(config: NetworkConfig, scale: float, seed: int) -> None:
    points, _ = scene(seed=seed)
    shift = np.array([5.8e5, 5.3e6, 500.0, -7e3, 2e2, 1e4])
    reference = pair_input(points, 0.05, config)
    assert_same(reference, pair_input(points * scale, 0.05 * scale, config))
    assert_same(reference, pair_input(points + shift, 0.05, config))


def test_rotating_either_cloud_leaves_invariant_channels_and_neighbours() -> None:
    points, _ = scene()
    reference = pair_input(points, 0.05, BLIND)
    for seed in range(4):
        R1, R2 = Rotation.random(2, random_state=seed).as_matrix()
        turned = np.concatenate([points[:, :3] @ R1.T, points[:, 3:] @ R2.T + 3], axis=1)
        other = pair_input(turned, 0.05, BLIND)
        assert reference.channels is not None
        assert other.channels is not None
        torch.testing.assert_close(other.channels, reference.channels, atol=5e-3, rtol=0)
        same = (other.neighbors == reference.neighbors).float().mean()
        assert float(same) > 0.99
        assert not torch.allclose(other.coordinates, reference.coordinates, atol=0.1)


def test_network_without_coordinates_gives_the_same_logits_after_any_rigid_motion() -> None:
    torch.manual_seed(0)
    small = {"num_layers": 2, "width": 16, "num_sub_fields": 6, "num_heads": 2}
    model = GeoMoE(BLIND.model_copy(update=small)).eval()
    points, _ = scene()
    R = Rotation.random(random_state=3).as_matrix()
    turned = np.concatenate([points[:, :3], points[:, 3:] @ R.T - 2], axis=1)
    logits = []
    for array in (points, turned):
        batch = collate([pair_input(array, 0.05, model.config)])
        with torch.no_grad():
            logits.append(model(batch.coordinates, batch.channels, batch.neighbors).logits[-1])
    torch.testing.assert_close(*logits, atol=0.02, rtol=0.02)


@pytest.mark.parametrize("full", [1024, 64])
def test_order_is_followed_exactly(full: int) -> None:
    config = STRONGER.model_copy(update={"compatibility_full": full, "compatibility_anchors": 64})
    points, _ = scene()
    order = np.random.default_rng(1).permutation(len(points))
    a, b = pair_input(points, 0.05, config), pair_input(points[order], 0.05, config)
    torch.testing.assert_close(b.coordinates, a.coordinates[order], atol=1e-5, rtol=0)
    assert a.channels is not None
    assert b.channels is not None
    torch.testing.assert_close(b.channels, a.channels[order], atol=1e-3, rtol=0)
    place = torch.from_numpy(np.argsort(order))
    assert float((place[a.neighbors[order]] == b.neighbors).float().mean()) > 0.99


def test_channels_equal_their_definition_written_plainly() -> None:
    points, _ = scene(60, 20)
    x = torch.tensor(points / 0.05)
    x = (x - x.mean(0)).float()
    result = compatibility_inputs(x, STRONGER)
    p, q = x[:, :3].double(), x[:, 3:].double()
    C = ((torch.cdist(p, p) - torch.cdist(q, q)).abs() < 2).double()
    C.fill_diagonal_(0)
    S = C * (C @ C)
    _, vectors = torch.linalg.eigh(S)
    v = vectors[:, -1].abs()
    v = v / v.max()
    torch.testing.assert_close(result.channels[:, 0].double(), v, atol=0.02, rtol=0)
    torch.testing.assert_close(result.channels[:, 1], result.channels[:, 0].sqrt())
    torch.testing.assert_close(result.channels[:, 2].double(), 5 * C.mean(1), atol=1e-5, rtol=0)
    torch.testing.assert_close(result.channels[:, 3].double(), S.sum(1) / S.sum(1).max(), atol=1e-5, rtol=0)
    strengths = S.gather(1, result.neighbors[:, 1:])
    expected = S.topk(7, dim=1).values
    linked = expected > 0
    torch.testing.assert_close(strengths[linked], expected[linked])
    rows = torch.arange(60)[:, None].expand(60, 7)
    assert torch.equal(result.neighbors[:, 1:][~linked], rows[~linked])


def test_hypothesis_channels_equal_residuals_counted_plainly() -> None:
    from geomoe3d.geometry.kabsch import weighted_kabsch
    from geomoe3d.networks.compatibility import hypothesis_channels

    points, _ = scene(50, 25)
    x = torch.tensor(points / 0.05).float()
    x = x - x.mean(0)
    generator = torch.Generator().manual_seed(0)
    members = torch.randint(0, 25, (50, 6), generator=generator)
    strength = torch.rand(50, 6, generator=generator) + 0.1
    got = hypothesis_channels(x, torch.arange(50), members, strength, 2.0)
    T = weighted_kabsch(x[members][..., :3], x[members][..., 3:], strength).T_target_source.double()
    moved = torch.einsum("hij,nj->hni", T[:, :3, :3], x[:, :3].double()) + T[:, None, :3, 3]
    support = (1 - (moved - x[:, 3:].double()).square().sum(-1) / 4).clamp(min=0)
    score = support.sum(1)
    best = (support * score.square()[:, None]).amax(0)
    expected = torch.stack(
        [score / score.max(), (best / best.max()).sqrt(), score.log1p() / 3, support[score.argmax()]], 1
    )
    torch.testing.assert_close(got.double(), expected, atol=0.02, rtol=0)


@pytest.mark.parametrize("full", [1024, 100])
def test_channels_single_out_the_true_group(full: int) -> None:
    points, _ = scene(400, 40)
    config = STRONGER.model_copy(update={"compatibility_full": full, "compatibility_anchors": 100})
    pair = pair_input(points, 0.05, config)
    assert pair.channels is not None
    for column in (0, 3, 4, 5, 6, 7):
        inlier, outlier = pair.channels[:40, column], pair.channels[40:, column]
        assert float(inlier.median()) > float(outlier.quantile(0.9)), column
    assert float((pair.neighbors[:40, 1:] < 40).float().mean()) > 0.95


@pytest.mark.parametrize("config", [FAITHFUL, STRONGER])
@pytest.mark.parametrize("kind", ["three", "same", "line", "plane", "incompatible"])
def test_degenerate_sets_give_finite_inputs(config: NetworkConfig, kind: str) -> None:
    rng = np.random.default_rng(0)
    points = {
        "three": rng.normal(size=(3, 6)),
        "same": np.ones((30, 6)),
        "line": np.linspace(0, 1, 30)[:, None] * np.ones(6),
        "plane": rng.uniform(0, 1, (30, 6)) * [1, 1, 0, 1, 1, 0],
        "incompatible": rng.uniform(0, 1e4, (30, 6)),
    }[kind]
    pair = pair_input(points, 0.05, config)
    assert torch.isfinite(pair.coordinates).all()
    assert pair.neighbors.shape == (len(points), 8)
    assert int(pair.neighbors.min()) >= 0
    assert int(pair.neighbors.max()) < len(points)
    assert pair.channels is None or torch.isfinite(pair.channels).all()


class LargestTensor(TorchDispatchMode):
    """Remembers the largest number of elements that any operation inside returned."""

    def __init__(self) -> None:
        super().__init__()
        self.numel = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        out = func(*args, **(kwargs or {}))
        for x in out if isinstance(out, (tuple, list)) else [out]:
            if isinstance(x, torch.Tensor) and not any(stride == 0 for stride in x.stride()):
                self.numel = max(self.numel, x.numel())
        return out


@pytest.mark.parametrize("config", [FAITHFUL, STRONGER])
def test_inputs_of_many_correspondences_never_make_an_n_by_n_table(config: NetworkConfig) -> None:
    num = 3000
    points, _ = scene(num, 300)
    with LargestTensor() as seen:
        pair = pair_input(points, 0.05, config)
    assert pair.neighbors.shape == (num, 8)
    assert seen.numel <= num * config.compatibility_anchors


def test_forward_and_backward_never_make_an_n_by_n_tensor() -> None:
    num = 2000
    config = NetworkConfig(num_layers=1, width=16, num_sub_fields=6, num_heads=2, expert_width=4)
    model = GeoMoE(config).train()
    x = torch.randn(2, num, 6, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(2, num, dtype=torch.bool)
    mask[1, 1500:] = False
    for padding in (None, mask):
        with LargestTensor() as seen:
            model(x, mask=padding).logits.sum().backward()
        # d' x K values per correspondence in the local context are the most.
        assert seen.numel <= 2 * num * 8 * 8


def test_wrong_input_is_named() -> None:
    points, _ = scene()
    with pytest.raises(InputError, match="at least 3"):
        pair_input(points[:2], 0.05, FAITHFUL)
    with pytest.raises(InputError, match=r"\(N, 6\)"):
        pair_input(points[:, :4], 0.05, FAITHFUL)
    with pytest.raises(InputError, match="voxel_size"):
        pair_input(points, 0.0, FAITHFUL)
    with pytest.raises(InputError, match="'ratio'"):
        pair_input(points, 0.05, NetworkConfig(extra_channels=("ratio",)))
    points[4, 2] = np.nan
    with pytest.raises(NonFiniteError, match="NaN"):
        pair_input(points, 0.05, FAITHFUL)


def test_collate_pads_and_keeps_every_pair() -> None:
    config = NetworkConfig(extra_channels=("ratio", "mutual"))
    pairs = []
    for n in (5, 12):
        points, _ = scene(n, 3)
        pairs.append(pair_input(points, 0.05, config, ratio=np.ones(n), mutual=np.arange(n) % 2 == 0))
    batch = collate(pairs)
    assert isinstance(batch, BatchInput)
    assert batch.mask is not None
    assert batch.mask.sum(1).tolist() == [5, 12]
    assert torch.equal(batch.coordinates[0, :5], pairs[0].coordinates)
    assert torch.equal(batch.neighbors[1], pairs[1].neighbors)
    assert int(batch.neighbors[0, 5:].min()) >= 5
    assert collate(pairs[:1]).mask is None


def test_more_anchors_than_the_fewest_correspondences_are_refused() -> None:
    with pytest.raises(ConfigError, match="compatibility_anchors 512 exceeds compatibility_full 100"):
        build_config(NetworkConfig, {"compatibility_full": 100})
