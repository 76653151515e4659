"""When a pair is looked at again: with another descriptor, more matches and coarser grids."""

from __future__ import annotations

import numpy as np
import pytest

from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import RegistrationConfig, load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision import selection as selection_module
from geomoe3d.errors import ConfigError, EmptyCloudError
from geomoe3d.geometry.se3 import rotation_error_deg
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.registration import Registrar

VOXEL = 0.05


@pytest.fixture
def grids_seen(monkeypatch):
    """Edges of the grids on which hypotheses were sought, all with the same places of the sensors.

    Where more matches of a grid were asked for than usual, its edge is followed by their number.
    """
    seen: list[float] = []
    match_clouds = Pipeline.match

    def spy(self, clouds, places, clock, limit=None, **more):
        found = match_clouds(self, clouds, places, clock, limit, **more)
        seen.append(round(clouds[0].voxel_size / VOXEL, 6))
        if limit is not None:
            seen.append(len(found.matched))
        np.testing.assert_array_equal(places, np.zeros((2, 3)))
        return found

    monkeypatch.setattr(Pipeline, "match", spy)
    monkeypatch.setattr("geomoe3d.line.is_sure", lambda *_: True)  # else a mirrored source is matched too
    return seen


def test_a_sure_answer_takes_no_second_look(grids_seen):
    source, target, _ = make_sample_pair(seed=0)
    assert Registrar(load_config(None, [f"voxel_size={VOXEL}"])).register(source, target).ok
    assert grids_seen == [1]


UNSURE = ["decision.min_confidence=1.0", "second_look.below=1.0"]


ONE_DESCRIPTOR = "second_look.descriptor=none"


def test_an_answer_not_ok_but_likely_takes_no_second_look(grids_seen):
    source, target, _ = make_sample_pair(seed=0)
    likely = [f"voxel_size={VOXEL}", "decision.min_confidence=1.0", ONE_DESCRIPTOR]
    registrar = Registrar(load_config(None, likely))
    answer = registrar.register(source, target)
    assert answer.status == "low_confidence"
    assert 0.8 < answer.confidence < 1
    assert grids_seen == [1]


def test_an_unsure_answer_takes_one_at_more_matches_and_on_every_coarser_grid(grids_seen):
    source, target, T = make_sample_pair(seed=0)
    settings = [f"voxel_size={VOXEL}", *UNSURE, ONE_DESCRIPTOR, "matching.max_correspondences=500"]
    few = [*settings, "second_look.max_correspondences=700"]
    result = Registrar(load_config(None, few)).register(source, target)
    assert grids_seen == [1, 1, 700, 1.5, 2]
    assert rotation_error_deg(result.T_target_source, T) < 1
    assert result.voxel_size == VOXEL
    grids_seen.clear()
    Registrar(load_config(None, [*few, "second_look.grids=[]"])).register(source, target)
    assert grids_seen == [1, 1, 700]
    for most in (0, 500):  # no more than there were
        grids_seen.clear()
        alone = [*settings, f"second_look.max_correspondences={most}"]
        Registrar(load_config(None, alone)).register(source, target)
        assert grids_seen == [1, 1.5, 2]
    grids_seen.clear()
    every = [f"voxel_size={VOXEL}", *UNSURE, ONE_DESCRIPTOR, "matching.max_correspondences=100000"]
    Registrar(load_config(None, every)).register(source, target)
    assert grids_seen == [1, 1.5, 2]


def test_an_answer_that_is_not_ok_is_described_again_and_both_kinds_of_matches_are_judged(grids_seen):
    source, target, T = make_sample_pair(seed=0)
    settings = [f"voxel_size={VOXEL}", "decision.min_confidence=1.0", "matching.max_correspondences=500"]
    registrar = Registrar(load_config(None, settings))  # likely, so no more than that
    found = registrar.explain(source, target)
    assert grids_seen == [1, 1]
    assert rotation_error_deg(found.result.T_target_source, T) < 1
    rows = np.stack([found.correspondences.source_index, found.correspondences.target_index], axis=1)
    assert 500 < len(rows) <= 1000
    assert len(np.unique(rows, axis=0)) == len(rows) == len(found.weights) == len(found.inliers)
    assert found.result.num_correspondences == len(rows)
    grids_seen.clear()
    unsure = load_config(None, [*settings, "second_look.below=1.0", "second_look.max_correspondences=700"])
    more = Registrar(unsure).explain(source, target)
    assert grids_seen == [1, 1, 1, 700, 1, 700, 1.5, 2]  # more matches by either, coarser grids by the second
    assert len(more.correspondences) == 1000  # of all of them, mutual ones first
    assert more.correspondences.mutual.all()


def test_the_descriptor_of_the_second_look_decides_identity_and_may_be_none_or_one_of_your_own(tmp_path):
    def line(name: str) -> Pipeline:
        return Pipeline(resolved(load_config(None, [f"second_look.descriptor={name}"])))

    named = {name: line(name) for name in ("none", "fpfh", "multiscale", "learned")}
    assert named["none"].second_descriptor is named["fpfh"].second_descriptor is None
    identities = [pipeline.identity()["parts"] for pipeline in named.values()]
    assert identities[0] == identities[1]
    assert identities[1] != identities[2] != identities[3] != identities[1]
    own = tmp_path / "own.py"
    own.write_text(
        "import numpy as np\n"
        "from geomoe3d.features.base import Descriptor\n"
        "class Blind(Descriptor):\n"
        "    dimension = 2\n"
        "    def __call__(self, cloud):\n"
        "        return np.tile([1.0, 0.0], (len(cloud), 1))\n"
    )
    assert line(f"{own}:Blind").second_descriptor.dimension == 2
    with pytest.raises(ConfigError, match=r"'learnt'; did you mean 'learned'"):
        line("learnt")


def test_an_answer_of_the_second_descriptor_must_be_surer(monkeypatch):
    asked, judge = [], selection_module.judge

    def spy(*given):
        asked.append(given[5].min_confidence)
        return judge(*given)

    monkeypatch.setattr(selection_module, "judge", spy)
    source, target, _ = make_sample_pair(seed=0)
    for decision, second, expected in ((0.99999, 1.0, [0.99999, 1.0]), (1.0, 0.98, [1.0, 1.0])):
        asked.clear()
        limits = [f"decision.min_confidence={decision}", f"second_look.min_confidence={second}"]
        result = Registrar(load_config(None, [f"voxel_size={VOXEL}", *limits])).register(source, target)
        assert asked[:2] == expected  # what comes after asks by the first descriptor
        assert result.status == "low_confidence"
    assert RegistrationConfig().second_look.min_confidence > RegistrationConfig().decision.min_confidence


def test_a_user_s_own_matches_are_not_described_again(grids_seen):
    source, target, T = make_sample_pair(seed=0)
    points = source.file_points[::40]
    rows = np.hstack([points, points @ T[:3, :3].T + T[:3, 3]])
    settings = load_config(None, [f"voxel_size={VOXEL}", *UNSURE])
    answer = Registrar(settings).register(source, target, correspondences=rows)
    assert answer.num_correspondences == len(rows)
    assert grids_seen == []


def test_clouds_too_small_for_a_coarser_grid_are_no_error(grids_seen, monkeypatch):
    def small(cloud, voxel_size, config, **more):
        if voxel_size > VOXEL:
            raise EmptyCloudError("2 points remain")
        return prepare(cloud, voxel_size, config, **more)

    monkeypatch.setattr("geomoe3d.pipeline.prepare", small)
    source, target, _ = make_sample_pair(seed=0)
    settings = [f"voxel_size={VOXEL}", *UNSURE, ONE_DESCRIPTOR, "second_look.max_correspondences=0"]
    assert Registrar(load_config(None, settings)).register(source, target).status != "failed"
    assert grids_seen == [1]


def test_a_second_look_on_a_finer_grid_is_refused():
    with pytest.raises(ConfigError, match=r"second_look.grids.*above 1"):
        load_config(None, ["second_look.grids=[0.5]"])
