"""Groups that no pair joins: their merged models are registered with each other, and with single scans."""

from __future__ import annotations

import numpy as np
import pytest
from small_scans import CUTS, SETTINGS, cut, scene

from geomoe3d.batch.run import Labour
from geomoe3d.batch.store import BatchStore
from geomoe3d.config import load_config
from geomoe3d.geometry.se3 import inverse, shift_frames
from geomoe3d.multiway.assembly import Assembly
from geomoe3d.multiway.maps import MapPair, whole_pairs
from geomoe3d.multiway.rules import Group
from geomoe3d.multiway.scans import find_scans
from geomoe3d.multiway.survey import Survey

pytestmark = pytest.mark.usefixtures("own_cache")


def group(*scans):
    """Scans in a row, a unit apart."""
    poses = {}
    for place, scan in enumerate(scans):
        poses[scan] = np.eye(4)
        poses[scan][0, 3] = place
    return Group(poses)


def test_whole_groups_are_paired_and_the_largest_with_single_scans():
    three, two, alone = group(4, 9, 2), group(5, 1), group(7)
    found = whole_pairs([three, two, alone])
    assert found == [MapPair(1, 9, ((1, 5), (9, 2, 4)))]  # local maps hold all of the others
    four = group(4, 9, 2, 3)
    assert whole_pairs([four, alone]) == [MapPair(7, 2, ((7,), (2, 3, 4, 9)))]
    assert whole_pairs([group(*range(61)), group(70)]) == []


def test_the_merged_models_of_two_groups_join_what_no_pair_does(tmp_path):
    points, truth, files = scene(), {}, []
    for number, bounds in enumerate(CUTS):
        part, truth[number] = cut(points, *bounds, seed=number)
        files.append(tmp_path / f"scan_{number}.npy")
        np.save(files[-1], part)
    config = load_config(None, SETTINGS)
    store = BatchStore(tmp_path / "pairs", config)
    told: list[tuple[int, int]] = []
    labour = Labour(1, None, None).checked()
    survey = Survey(find_scans(files), config, store, labour, lambda *now: told.append(now), print)
    survey.describe({})
    store.begin()
    local = {k: shift_frames(T, -survey.shapes[k].origin, np.zeros(3)) for k, T in truth.items()}
    groups = [Group({k: local[k] for k in scans}) for scans in ((0, 1, 2), (3, 4))]
    (pair,) = survey.whole_pairs(groups)
    survey.register_maps([pair], groups)
    (edge,) = survey.map_edges.values()
    assert edge.of_maps
    error = inverse(local[pair.target]) @ local[pair.source] - edge.T_target_source
    assert np.abs(error).max() < 0.05
    survey.register([(0, 1), (1, 2), (3, 4)])
    assert told == [(0, 1), (1, 1), *((done, 4) for done in (1, 2, 3, 4))]  # never fewer than before
    (whole,) = Assembly(survey).groups()
    assert sorted(whole.poses) == [0, 1, 2, 3, 4]
