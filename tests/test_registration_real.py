"""Real scans: the register command as a user meets it, and a sample of the benchmark's pairs."""

from __future__ import annotations

import json

import numpy as np
import pytest

from geomoe3d.cli.errors import run
from geomoe3d.cli.register import command
from geomoe3d.clouds.io import load_points
from geomoe3d.config import load_config
from geomoe3d.data.threedmatch import find_data_root, load_benchmark
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import inverse, rotation_error_deg, shift_frames, translation_error
from geomoe3d.registration import Registrar

pytestmark = pytest.mark.real_data


@pytest.fixture(scope="module")
def data():
    try:
        return find_data_root()
    except InputError as error:
        pytest.skip(str(error))


def test_full_resolution_fragments_through_the_command_line(data, tmp_path, capsys):
    folder = data / "fullres"
    truth = next(
        p.T_target_source
        for p in load_benchmark(data, "3DMatch")
        if (p.scene, p.source_index, p.target_index) == ("7-scenes-redkitchen", 0, 4)
    )
    output = tmp_path / "T.txt"
    files = [str(folder / f"redkitchen_cloud_bin_{k}.ply") for k in (4, 0)]
    assert run(command, "register", [*files, "--json", "--output", str(output)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["status"] == "ok"
    T = np.array(result["T_target_source"])
    assert rotation_error_deg(T, inverse(truth)) < 2.5
    assert translation_error(T, inverse(truth)) < 0.08
    assert np.array_equal(np.loadtxt(output), T)


def test_twenty_random_benchmark_pairs(data):
    pairs = load_benchmark(data, "3DMatch")
    chosen = np.random.default_rng(0).choice(len(pairs), 20, replace=False)
    registrar = Registrar()
    right = 0
    for k in chosen:
        pair = pairs[k]
        T = registrar.register(pair.source, pair.target).T_target_source
        right += (
            rotation_error_deg(T, pair.T_target_source) < 15
            and translation_error(T, pair.T_target_source) < 0.30
        )
    assert right >= 18


def test_fragments_of_different_scenes_are_not_accepted(data):
    fragments = data / "3dmatch-dev" / "fragments"
    kitchen = fragments / "7-scenes-redkitchen"
    hotel = fragments / "sun3d-hotel_umd-maryland_hotel1"
    registrar = Registrar()
    for k in (3, 21, 40):
        result = registrar.register(kitchen / f"cloud_bin_{k}.ply", hotel / f"cloud_bin_{k}.ply")
        assert result.status != "ok"
        assert result.reasons


def test_a_sensor_guessed_on_the_wrong_side_is_made_up_for(data):
    pair = next(
        p
        for p in load_benchmark(data, "3DLoMatch")
        if (p.scene, p.source_index, p.target_index) == ("sun3d-home_at-home_at_scan1_2013_jan_1", 17, 20)
    )
    clouds = [load_points(path).file_points for path in (pair.source, pair.target)]
    middles = [points.mean(0) for points in clouds]
    source, target = (points - middle for points, middle in zip(clouds, middles, strict=True))
    truth = shift_frames(pair.T_target_source, -middles[0], -middles[1])
    once = Registrar(load_config(None, ["second_look.flip=false"])).register(source, target)
    assert once.status != "ok"
    assert any("sensors stood is not known" in reason for reason in once.reasons)
    result = Registrar().register(source, target)
    assert result.status == "ok"
    assert rotation_error_deg(result.T_target_source, truth) < 15
    assert translation_error(result.T_target_source, truth) < 0.30
