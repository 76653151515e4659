"""Descriptors on three grids: invariance, numpy and torch, what is found on a generated pair, training."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.errors import CheckpointError
from geomoe3d.features.base import Descriptor, with_features, with_normals_flipped
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.features.learned import LEARNED, WEIGHTS, LearnedDescriptor, load_tensors
from geomoe3d.features.multiscale import MultiscaleDescriptor
from geomoe3d.features.pyramid import FACTORS, nearest, pyramid, relations
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.types import PreparedCloud

DESCRIPTORS = (MultiscaleDescriptor, LearnedDescriptor)


@pytest.fixture(scope="module")
def pair() -> tuple[PreparedCloud, PreparedCloud, np.ndarray]:
    """Two views of a furnished room on a 6 cm grid, sensors at the origins, and the true motion."""
    source, target, T = make_sample_pair(3)
    clouds = [prepare(c, 0.06, PreparationConfig(), viewpoint=-c.origin) for c in (source, target)]
    return clouds[0], clouds[1], T


@pytest.mark.parametrize("kind", DESCRIPTORS)
def test_features_are_unit_repeatable_and_the_same_in_any_unit(kind: type[Descriptor], pair) -> None:
    cloud = pair[0]
    features = kind()(cloud)
    assert features.shape == (len(cloud), kind.dimension) and features.dtype == np.float32
    assert np.allclose(np.linalg.norm(features, axis=1), 1, atol=1e-4)
    assert np.array_equal(features, kind()(cloud))
    millimetres = replace(cloud, points=1000 * cloud.points, voxel_size=1000 * cloud.voxel_size)
    assert np.allclose(kind()(millimetres), features, atol=2e-3)


@pytest.mark.parametrize("kind", DESCRIPTORS)
@pytest.mark.parametrize("count", [1, 3, 20])
def test_clouds_of_few_points_have_finite_features(kind: type[Descriptor], count: int) -> None:
    rng = np.random.default_rng(count)
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    cloud = PreparedCloud(rng.normal(size=(count, 3)), normals, None, 0.5, None, np.zeros(3))
    assert np.isfinite(with_features(cloud, kind()).features).all()


def test_fpfh_that_is_there_is_not_computed_again(pair, monkeypatch) -> None:
    plain, first = LearnedDescriptor()(pair[0]), FpfhDescriptor()
    described = with_features(pair[0], first)
    of_others = LearnedDescriptor().again(described, FpfhDescriptor(radius=3.0))
    asked = []
    compute = FpfhDescriptor.__call__
    monkeypatch.setattr(
        FpfhDescriptor, "__call__", lambda self, c: (asked.append(len(c)), compute(self, c))[1]
    )
    again = with_features(described, LearnedDescriptor(), first).features
    assert len(asked) == 2 and max(asked) < len(pair[0])
    assert np.array_equal(again, plain) and np.array_equal(of_others, plain)


def test_relations_turn_with_the_cloud(pair) -> None:
    fine, middle, _ = pyramid(pair[0])
    at = fine.take(np.arange(200))
    distance, rows = nearest(at, middle, 16)
    R = Rotation.random(random_state=1).as_matrix().astype(np.float32)
    turned = [
        replace(level, points=level.points @ R.T, normals=level.normals @ R.T) for level in (at, middle)
    ]
    assert np.array_equal(distance, np.sort(distance, axis=1))
    assert np.allclose(relations(*turned, rows.T), relations(at, middle, rows.T), atol=2e-4)


def test_levels_are_coarser_by_their_factor(pair) -> None:
    levels = pyramid(pair[0])
    assert [level.edge for level in levels] == list(FACTORS)
    for finer, coarser in itertools.pairwise(levels):
        assert len(coarser) < len(finer) / 2
        assert np.isin(coarser.rows, levels[0].rows).all()


def share_of_right_matches(describe: Descriptor, pair) -> float:
    """Of 500 of the source's points that the target shares: how many find one within two voxels of it."""
    source, target, T = pair
    moved = transform_points(T, source.points)
    near, _ = cKDTree(target.points).query(moved)
    shared = np.random.default_rng(0).permutation(np.flatnonzero(near < source.voxel_size))[:500]
    found = (describe(source)[shared] @ describe(target).T).argmax(1)
    apart = np.linalg.norm(moved[shared] - target.points[found], axis=1)
    return float(np.mean(apart < 2 * source.voxel_size))


def test_learned_features_find_more_than_joined_ones_and_these_more_than_fpfh(pair) -> None:
    fpfh, joined, learned = (
        share_of_right_matches(kind(), pair)
        for kind in (FpfhDescriptor, MultiscaleDescriptor, LearnedDescriptor)
    )
    assert fpfh < joined < learned


def test_turning_all_normals_over_leaves_what_is_found(pair) -> None:
    source, target, T = pair
    as_seen = share_of_right_matches(LearnedDescriptor(), pair)
    turned = [replace(cloud, normals=-cloud.normals) for cloud in (source, target)]
    assert share_of_right_matches(LearnedDescriptor(), (*turned, T)) > 0.5 * as_seen
    flipped = with_normals_flipped(source, LearnedDescriptor())
    assert flipped.viewpoint is None and not np.allclose(
        flipped.features, LearnedDescriptor()(source), atol=0.1
    )


def test_weights_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no weights"):
        LearnedDescriptor(str(tmp_path / "none.safetensors"))
    (tmp_path / "cut.safetensors").write_bytes(WEIGHTS.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="cannot be read"):
        LearnedDescriptor(str(tmp_path / "cut.safetensors"))
    other = Path("geomoe3d/networks/weights/geomoe3d.safetensors")
    with pytest.raises(CheckpointError, match="holds no weights"):
        LearnedDescriptor(str(other))


def test_numpy_gives_what_torch_gives(pair) -> None:
    torch = pytest.importorskip("torch")
    from geomoe3d.training.descriptor_network import DescriptorNetwork
    from geomoe3d.training.descriptor_views import Fragment, batch_view

    network = DescriptorNetwork().eval()
    network.load_state_dict({k: torch.from_numpy(v) for k, v in load_tensors(WEIGHTS).items()})
    rows = np.arange(0, len(pair[0]), 7)
    with torch.no_grad():
        fragment = Fragment.of(pyramid(pair[0]), "cpu", torch.float32)
        assert fragment is not None
        expected = network(batch_view([fragment], [torch.from_numpy(rows)])).numpy()
    found = LearnedDescriptor()(pair[0])[rows, :LEARNED]
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    assert expected.shape == (len(rows), LEARNED)
    assert np.allclose(found, expected, atol=1e-4)


@pytest.fixture(scope="module")
def shards(tmp_path_factory, pair) -> Path:
    """One scene of the two views, as ``geomoe3d data features`` writes it."""
    from geomoe3d.data.shards import DescribedScene, write_shard

    source, target, T = pair
    # What both see, and less of the rest: training on a processor is slow.
    near = transform_points(T, source.points)
    kept = cKDTree(target.points).query(near)[0] < 0.1, cKDTree(near).query(target.points)[0] < 0.1
    points = [
        cloud.points[rows][:1200].astype(np.float32)
        for cloud, rows in zip((source, target), kept, strict=True)
    ]
    count = sum(map(len, points))
    scene = DescribedScene(
        "room",
        np.concatenate(points),
        np.zeros((count, 33), np.float16),
        np.array([0, len(points[0]), count]),
        np.array([[0, 1]]),
        T[None],
        np.array([0.3], np.float32),
        0.06,
    )
    folder = tmp_path_factory.mktemp("shards")
    write_shard(folder / "room", scene, {}, "")
    return folder


def test_relations_in_torch_are_those_of_registration(pair) -> None:
    torch = pytest.importorskip("torch")
    from geomoe3d.training.descriptor_views import Grid, torch_relations

    fine, middle, _ = pyramid(pair[0])
    at = fine.take(np.arange(200))
    _, rows = nearest(at, middle, 16)
    grids = [
        Grid(*map(torch.from_numpy, (level.points, level.normals, level.features)), level.edge)
        for level in (at, middle)
    ]
    found = torch_relations(grids[0], grids[1], torch.from_numpy(rows)).numpy()
    assert np.allclose(found.swapaxes(0, 1), relations(at, middle, rows.T), atol=1e-5)


def test_a_batch_of_views_is_each_of_them(shards: Path) -> None:
    torch = pytest.importorskip("torch")
    from geomoe3d.training.descriptor_network import DescriptorNetwork
    from geomoe3d.training.descriptor_pairs import ContrastPairs
    from geomoe3d.training.descriptor_views import batch_view

    pairs = ContrastPairs([str(shards)])
    fragments = [f for index in range(2) if (f := pairs._fragment(0, index)) is not None]
    assert len(fragments) == 2
    fragments += [f.turned_over() for f in fragments]
    network = DescriptorNetwork().eval()
    queries = [torch.arange(5 + k) for k in range(4)]
    with torch.no_grad():
        together = network(batch_view(fragments, queries))
        alone = [network(batch_view([f], [q])) for f, q in zip(fragments, queries, strict=True)]
    assert torch.allclose(together, torch.cat(alone), atol=1e-5)


def test_shared_points_of_a_drawn_pair_are_the_same_places(shards: Path) -> None:
    torch = pytest.importorskip("torch")
    from geomoe3d.training.descriptor_pairs import ContrastPairs

    drawn, again, other = (
        ContrastPairs([str(shards)], seed, num_shared=50, num_random=70).batch(4, 3) for seed in (0, 0, 1)
    )
    assert drawn.apart.shape == (6, 50, 120)
    assert float(drawn.apart.diagonal(dim1=1, dim2=2).max()) < 0.9
    assert torch.equal(drawn.apart, again.apart) and not torch.equal(drawn.apart, other.apart)
    assert torch.equal(drawn.view.given[0], again.view.given[0])


@pytest.mark.usefixtures("one_thread")
def test_training_learns_one_pair_and_goes_on_where_it_was(shards: Path, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from geomoe3d.training.descriptor import DescriptorRun, DescriptorTrainConfig

    config = DescriptorTrainConfig(
        data=(str(shards),), steps=12, batch_size=1, leave_out=0, save_every=6, num_shared=60, num_random=60
    )
    said: list[str] = []
    whole = DescriptorRun(config, tmp_path / "whole")
    path = whole.train(said.append)
    first, last = (float(line.split(": ")[1].split(",")[1]) for line in said)
    assert last < first
    assert DescriptorRun(config, tmp_path / "parts").train(said.append, until=6) is None
    resumed = DescriptorRun(config, tmp_path / "parts")
    assert resumed.step == 6
    resumed.train(said.append)
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, resumed.network.state_dict()[name])
    assert path is not None and LearnedDescriptor(str(path)).weights == str(path)
    with pytest.raises(CheckpointError, match="other settings"):
        DescriptorRun(config.model_copy(update={"steps": 13}), tmp_path / "parts")
