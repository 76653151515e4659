"""Methods by name: ours on pairs with a known motion; identities and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from method_pairs import MOTION, correspondences, lands, pair_of

from geomoe3d.data.sample import make_sample_pair
from geomoe3d.errors import CheckpointError, ConfigError, GeoMoE3DError, InputError
from geomoe3d.evaluation import methods
from geomoe3d.evaluation.methods import OURS, make_method, method_names
from geomoe3d.evaluation.records import MethodInput
from geomoe3d.geometry.se3 import rotation_error_deg, transform_points, translation_error

UTM = np.array([583394.0, 5283100.0, 498.0])


@pytest.fixture(scope="module")
def room():
    source, target, T = make_sample_pair(seed=0)
    return source.file_points, target.file_points, T


# ---- ours on correspondences ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["geomoe3d", "geomoe", "consensus"])
def test_ours_land_among_wrong_correspondences(name):
    rows = correspondences(0.3)
    answer = make_method(name)(pair_of(rows))
    assert lands(answer.T_target_source)
    assert set(answer.stages) == {"propose"} | ({"score"} if name != "consensus" else set())
    assert answer.status is None
    assert (answer.weights is None) == (answer.inliers is None) == (name == "consensus")
    if answer.inliers is not None:
        assert answer.inliers.shape == (len(rows),)
    assert all(not np.array_equal(T, answer.T_target_source) for T in answer.hypotheses)


def test_spectral_matching_keeps_a_tenth_and_lands():
    rows = correspondences(0.6)
    answer = make_method("spectral")(pair_of(rows))
    assert lands(answer.T_target_source, degrees=3, metres=0.15)
    right = np.linalg.norm(transform_points(MOTION, rows[:, :3]) - rows[:, 3:], axis=1) < 0.1
    assert answer.inliers is not None
    assert answer.inliers.sum() == round(0.1 * len(rows))
    assert right[answer.inliers].all()


def test_plain_svd_is_least_squares_of_all_rows():
    assert lands(make_method("svd")(pair_of(correspondences(1.0))).T_target_source)
    assert not lands(make_method("svd")(pair_of(correspondences(0.6))).T_target_source)


def test_map_coordinates_do_not_matter():
    rows = correspondences(0.5)
    near = make_method("geomoe3d")(pair_of(rows))
    far = make_method("geomoe3d")(pair_of(rows + np.tile(UTM, 2)))
    assert near.T_target_source is not None
    assert far.T_target_source is not None
    moved = transform_points(far.T_target_source, rows[:, :3] + UTM) - UTM
    assert np.abs(moved - transform_points(near.T_target_source, rows[:, :3])).max() < 1e-3


def test_same_seed_same_answer():
    rows = correspondences(0.2, count=800)
    for assignments in ((), ("estimator.name=ransac",)):
        one, two = (make_method("geomoe3d", assignments)(pair_of(rows, seed=3)) for _ in range(2))
        assert one.T_target_source is not None
        assert one.T_target_source.tobytes() == two.T_target_source.tobytes()


def test_seed_of_the_input_reaches_the_estimator():
    rows = correspondences(0.1, count=800)
    # Too few samples among too many wrong rows: what is found depends on the draw.
    few = ["scoring.scorers=[surfaces]", "estimator.name=ransac", "estimator.ransac_iterations=300"]
    method = make_method("geomoe3d", few)
    answers = [method(pair_of(rows, seed=seed)).T_target_source for seed in range(6)]
    assert len({None if T is None else T.tobytes() for T in answers}) > 1


@pytest.mark.parametrize("name", list(OURS))
def test_no_motion_is_no_answer(name):
    on_a_line = np.outer(np.arange(20.0), [1, 0, 0, 0, 1, 0])
    for rows in (np.zeros((0, 6)), correspondences(1.0, count=2), on_a_line):
        answer = make_method(name)(pair_of(rows))
        assert answer.T_target_source is None
        assert answer.hypotheses == ()


def test_threshold_of_the_input_unless_assigned():
    rows = correspondences(1.0)
    rows[::2, 3] += 0.25  # inliers only of a wide threshold; they pull a fit towards them
    close = make_method("geomoe3d")(pair_of(rows)).T_target_source
    wide = make_method("geomoe3d", ["estimator.inlier_threshold=12"])(pair_of(rows)).T_target_source
    assert translation_error(close, MOTION) < 0.02 or abs(translation_error(close, MOTION) - 0.25) < 0.02
    assert 0.04 < translation_error(wide, MOTION) < 0.21


def test_missing_input_is_named():
    with pytest.raises(InputError, match=r"room/0-1: 'svd' takes correspondences"):
        make_method("svd")(MethodInput("room/0-1", source=np.zeros((5, 3)), target=np.zeros((5, 3))))


# ---- ours on clouds ---------------------------------------------------------------------------------


def test_clouds_give_what_a_report_needs_in_file_coordinates(room):
    source, target, T = room
    shift = np.array([3e5, -2e5, 1e3])
    given = MethodInput("room/0-1", source=source + shift, target=target)
    answer = make_method("geomoe3d")(given)
    assert answer.T_target_source is not None
    truth = T.copy()
    truth[:3, 3] -= T[:3, :3] @ shift
    assert rotation_error_deg(answer.T_target_source, truth) < 0.5
    centre = (source + shift).mean(0)[None]
    assert (
        np.abs(transform_points(answer.T_target_source, centre) - transform_points(truth, centre)).max()
        < 0.02
    )
    assert answer.status == "ok"
    assert answer.confidence is not None
    assert answer.confidence > 0.9
    assert "score" in answer.stages
    assert "total" not in answer.stages
    rows = answer.correspondences
    assert rows is not None
    assert answer.inliers is not None
    assert answer.inliers.shape == (len(rows),)
    extent = np.abs(rows[:, :3] - centre).max()
    assert extent < 10  # near the given source, not near zero
    near = np.linalg.norm(transform_points(answer.T_target_source, rows[:, :3]) - rows[:, 3:], axis=1) < 0.1
    assert near.sum() > 20


def test_hopeless_clouds_have_no_motion():
    rng = np.random.default_rng(0)
    given = MethodInput("a/0-1", source=rng.uniform(size=(500, 3)), target=1000 * rng.uniform(size=(500, 3)))
    answer = make_method("geomoe3d")(given)
    assert answer.T_target_source is None
    assert answer.status == "failed"
    assert len(answer.correspondences) == 0
    with pytest.raises(GeoMoE3DError):
        make_method("geomoe3d")(MethodInput("a/0-1", source=np.zeros((1, 3)), target=np.zeros((1, 3))))


# ---- the network ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch = pytest.importorskip("torch")
    from geomoe3d.networks.architecture import NetworkConfig
    from geomoe3d.networks.geomoe import GeoMoE
    from geomoe3d.networks.pretrained import save_pretrained
    from geomoe3d.networks.weight_files import WeightCard

    made = {}
    for name, channels in (("plain", ()), ("other", ()), ("matching", ("ratio",))):
        torch.manual_seed(len(made))
        config = NetworkConfig(num_layers=2, width=16, num_sub_fields=8, extra_channels=channels)
        made[name] = tmp_path_factory.mktemp("weights") / f"{name}.safetensors"
        save_pretrained(made[name], GeoMoE(config), WeightCard(architecture={}))
    return made


def network(path: Path) -> list[str]:
    return ["scoring.scorers=[surfaces]", "filter.name=geomoe", f"filter.weights={path}"]


def test_network_classifies_by_its_logits(weights):
    rows = correspondences(0.6)
    answer = make_method("geomoe3d", network(weights["plain"]))(pair_of(rows))
    assert answer.inliers is not None
    assert answer.weights is not None
    assert answer.inliers.dtype == np.bool_
    assert answer.inliers.shape == answer.weights.shape == (len(rows),)
    assert np.array_equal(answer.inliers, answer.weights > 0)


def test_identity_changes_with_the_weights(weights):
    one = make_method("geomoe3d", network(weights["plain"])).identity()
    two = make_method("geomoe3d", network(weights["other"])).identity()
    hashes = [identity["parts"]["filter"]["weights"] for identity in (one, two)]
    assert hashes[0] != hashes[1]
    assert len(hashes[0]) == 64
    assert "torch" in one["versions"]


def test_network_of_matching_channels_takes_no_bare_correspondences(weights):
    assert make_method("geomoe3d", network(weights["matching"])).inputs == {"clouds"}
    assert make_method("geomoe3d", network(weights["plain"])).inputs == {"clouds", "correspondences"}


def test_missing_weights_are_refused_before_any_pair():
    with pytest.raises(CheckpointError, match="nowhere"):
        make_method("geomoe3d", network(Path("nowhere.safetensors")))


@pytest.mark.parametrize(
    ("missing", "absent"), [("torch", {"geomoe-plain"}), ("safetensors", {"geomoe", "geomoe-plain"})]
)
def test_network_without_its_library_is_absent(missing, absent, monkeypatch):
    shipped = make_method("geomoe").identity()["parts"]["network"]["weights"]
    find = methods.importlib.util.find_spec
    monkeypatch.setattr(
        methods.importlib.util,
        "find_spec",
        lambda name, *rest: None if name == missing else find(name, *rest),
    )
    made = {name: make_method(name) for name in ("geomoe", "consensus")}
    made["geomoe-plain"] = make_method("geomoe-plain", ["filter.weights=mine.safetensors"])
    for name, method in made.items():
        said = method.absent()
        assert (said is not None) == (name in absent)
        assert said is None or f"pip install {missing}" in said
    assert made["geomoe"].identity()["parts"]["network"]["weights"] == shipped


# ---- names and identities ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "hint"),
    [("geomo3d", "geomoe3d"), ("open3d-ransac-50K", "open3d-ransac-50k"), ("kissmatcher", "kiss-matcher")],
)
def test_unknown_names_get_the_nearest(name, hint):
    with pytest.raises(InputError, match=f"did you mean '{hint}'"):
        make_method(name)


def test_far_off_names_get_the_whole_list():
    with pytest.raises(InputError, match=r"consensus.*gc-ransac.*file.py:function"):
        make_method("zzz")


def test_every_name_makes_a_method_with_a_plain_identity():
    assert len(set(method_names())) == len(method_names())
    for name in method_names():
        method = make_method(name)
        assert method.name == name
        assert method.inputs <= {"correspondences", "clouds"}
        assert method.inputs
        identity = method.identity()
        assert json.loads(json.dumps(identity)) == identity
        assert identity["versions"]["numpy"] == np.__version__


def test_identities_differ_where_answers_may():
    seen = [json.dumps(make_method(name).identity(), sort_keys=True) for name in method_names()]
    assert len(set(seen)) == len(seen) - 1  # geomoe3d without further settings is geomoe
    plain = make_method("geomoe3d").identity()
    assert make_method("geomoe3d", ["matching.neighbors=2"]).identity() != plain
    assert make_method("geomoe3d", ["estimator.inlier_threshold=2"]).identity() != plain
    assert make_method("geomoe3d").identity() == plain


@pytest.mark.parametrize("name", ["pointcn", "geomoe-plain"])
def test_networks_with_weights_of_the_user_are_methods(name, tmp_path):
    from tiny_networks import settle, small, tiny

    from geomoe3d.networks.pretrained import save_pretrained
    from geomoe3d.networks.weight_files import WeightCard

    path = tmp_path / "w.safetensors"
    network = settle(tiny() if name == "geomoe-plain" else small(name))
    save_pretrained(path, network, WeightCard(architecture={}))
    method = make_method(name, [f"filter.weights={path}"])
    assert method.inputs == {"correspondences"}
    rows = correspondences(0.6)
    answer = method(pair_of(rows))
    assert answer.weights.shape == answer.inliers.shape == (len(rows),)
    assert str(path) in json.dumps(method.identity())
    with pytest.raises(InputError, match=f"'{name}' needs trained weights"):
        make_method(name)


def test_assignments_are_for_those_that_take_any():
    for name in ("consensus", "open3d-fgr", "mine.py:register"):
        with pytest.raises(InputError, match="takes none; 'geomoe3d' and networks"):
            make_method(name, ["voxel_size=0.1"])
    with pytest.raises(ConfigError, match=r"matching\.neighbors"):
        make_method("geomoe3d", ["matching.neighbours=2"])
    with pytest.raises(ConfigError, match="seed"):
        make_method("geomoe3d", ["seed=2"])
