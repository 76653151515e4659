"""A result in the hands of somebody who writes Python: shown, saved, drawn, applied; errors, batches, progress."""

from __future__ import annotations

import copy
import importlib.util
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_scans import SETTINGS, UTM, cut, scene

import geomoe3d
from geomoe3d.clouds.transform_files import load_transform
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.registration import Registrar
from geomoe3d.runtime import progress as progress_module
from geomoe3d.visual.page import render_page

CONFIG = geomoe3d.load_config(None, [*SETTINGS, "scoring.scorers=[surfaces]"])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    for name, (low, high), seed in (("source", (0.0, 3.4), 1), ("target", (0.6, 4.0), 2)):
        np.save(folder / f"{name}.npy", cut(scene(), low, high, seed=seed)[0] + UTM)
    return folder / "source.npy", folder / "target.npy"


@pytest.fixture(scope="module")
def explanation(files):
    return Registrar(CONFIG).explain(*map(str, files))


@pytest.fixture(scope="module")
def result(explanation):
    assert explanation.result.has_transform
    return explanation.result


# ---- shown ---------------------------------------------------------------------------------------------


def test_repr_is_one_readable_paragraph(result):
    text = repr(result)
    assert text.startswith(f"<RegistrationResult {result.status}, confidence {result.confidence:.2f}")
    assert "'source.npy' into 'target.npy'" in text
    assert f"{result.num_inliers:,} of {result.num_correspondences:,} correspondences" in text
    assert "\n" not in text
    assert len(text) < 600


def test_repr_of_a_failure_gives_the_reason(files):
    points = np.load(files[0])
    failed = geomoe3d.register(points, (points - UTM) / 1000, config=CONFIG)
    assert not failed.has_transform
    assert "no transform that maps 'source' into 'target' was found" in repr(failed)
    assert failed.reasons[0] in repr(failed)
    assert failed.correspondences.shape == (0, 6)


def test_a_notebook_shows_words_and_clouds_to_turn(result):
    shown = result._repr_html_()
    assert f"confidence {result.confidence:.2f}" in shown
    assert shown.count("<iframe srcdoc=") == 1
    assert (
        "<script" not in shown
    )  # escaped into the attribute of the frame, where it cannot touch the notebook
    assert len(shown) < 400_000
    assert type(shown) is str


def test_a_notebook_shows_words_alone_where_the_clouds_are_gone(result):
    bare = geomoe3d.RegistrationResult.from_json(result.to_json())
    shown = replace(bare, source=replace(bare.source, name="<b>x"))._repr_html_()
    assert "<iframe" not in shown
    assert "&lt;b&gt;x" in shown


# ---- saved ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["T.txt", "T.npy", "T.json", "T.yaml", "T.tum", "T.kitti", "pdal:T.p", "ros:T.r"]
)
def test_every_format_of_the_command_line_is_saved(result, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    result.save(name)
    assert np.abs(load_transform(name.partition(":")[2] or name) - result.T_target_source).max() < 1e-8
    with pytest.raises(FileExistsError, match="force=True"):
        result.save(name)
    result.save(name, force=True)


def test_the_aligned_source_is_saved(result, files, tmp_path):
    assert result.save_aligned(tmp_path / "a.xyz") == ()
    moved = geomoe3d.load_points(tmp_path / "a.xyz").file_points
    np.testing.assert_allclose(moved, result.apply(np.load(files[0])), atol=1e-6)


def test_the_page_is_that_of_the_command_line(explanation, tmp_path):
    explanation.result.page(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text() == render_page(explanation.view())


def test_a_result_from_json_is_drawn_with_the_clouds_given(result, files, tmp_path):
    bare = geomoe3d.RegistrationResult.from_json(result.to_json())
    with pytest.raises(geomoe3d.InputError, match=r"source=\.\.\., target="):
        bare.picture(tmp_path / "picture.png")
    bare.picture(tmp_path / "picture.png", source=files[0], target=files[1])
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_a_cloud_that_was_moved_since_is_not_drawn(files, tmp_path):
    source = np.load(files[0])
    made = geomoe3d.register(source, files[1], config=CONFIG)
    source += 1.0
    with pytest.raises(geomoe3d.InputError, match="source is no longer what was registered: it moved"):
        made.page(tmp_path / "page.html")
    with pytest.raises(geomoe3d.InputError, match="points instead of"):
        made.page(tmp_path / "page.html", source=source[:-1])
    made.page(tmp_path / "page.html", source=files[0])


def test_correspondences_are_in_file_coordinates(result):
    rows = result.correspondences
    assert rows.shape == (result.num_correspondences, 6)
    away = np.linalg.norm(transform_points(result.T_target_source, rows[:, :3]) - rows[:, 3:], axis=1)
    np.testing.assert_array_equal(result.inliers, away < result.inlier_threshold)
    assert abs(int(result.inliers.sum()) - result.num_inliers) <= 1  # the origin rounds
    back = result.inverse()
    np.testing.assert_array_equal(back.correspondences, np.hstack([rows[:, 3:], rows[:, :3]]))
    bare = geomoe3d.RegistrationResult.from_json(result.to_json())
    with pytest.raises(geomoe3d.InputError, match="no longer holds its correspondences"):
        _ = bare.correspondences


def test_a_copy_between_processes_stays_small_and_remembers_paths(result, files):
    for other in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert other._inputs.source == str(files[0])
        np.testing.assert_array_equal(other.correspondences, result.correspondences)
    cloud = geomoe3d.load_points(files[0])
    made = geomoe3d.register(cloud, files[1], config=CONFIG)
    assert made._inputs.source is cloud
    assert pickle.loads(pickle.dumps(made))._inputs.source is None


# ---- applied -------------------------------------------------------------------------------------------


def kinds(points):
    import open3d
    import torch
    import trimesh

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    mesh = trimesh.creation.box()
    mesh.vertices = mesh.vertices + points[0]
    return {
        "array": (points, np.asarray),
        "tensor": (torch.as_tensor(points), lambda x: x.numpy()),
        "open3d": (cloud, lambda x: np.asarray(x.points)),
        "open3d tensor": (
            open3d.t.geometry.PointCloud(open3d.core.Tensor(points)),
            lambda x: x.point.positions.numpy(),
        ),
        "trimesh cloud": (trimesh.PointCloud(points), lambda x: np.asarray(x.vertices)),
        "trimesh": (mesh, lambda x: np.asarray(x.vertices)),
        "cloud": (geomoe3d.load_points(points), lambda x: x.file_points),
    }


@pytest.mark.parametrize(
    "kind", ["array", "tensor", "open3d", "open3d tensor", "trimesh cloud", "trimesh", "cloud"]
)
def test_apply_returns_the_kind_that_it_was_given(result, kind):
    data, points_of = kinds(np.random.default_rng(0).random((20, 3)) + UTM)[kind]
    before = np.array(points_of(data))
    made = result.apply(data)
    assert type(made) is type(data)
    np.testing.assert_allclose(points_of(made), transform_points(result.T_target_source, before), atol=1e-8)
    np.testing.assert_array_equal(points_of(data), before)


def test_apply_turns_normals_and_passes_gradients(result):
    import open3d
    import torch

    R = result.T_target_source[:3, :3]
    normals = np.eye(3)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.zeros((3, 3))))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    np.testing.assert_allclose(np.asarray(result.apply(cloud).normals), normals @ R.T, atol=1e-12)
    own = geomoe3d.PointCloud(np.zeros((3, 3)), normals=normals)
    np.testing.assert_allclose(result.apply(own).normals, normals @ R.T, atol=1e-12)
    points = torch.zeros((2, 3), dtype=torch.float32, requires_grad=True)
    moved = result.apply(points)
    assert moved.dtype == torch.float32
    moved[:, 0].sum().backward()
    np.testing.assert_allclose(points.grad.numpy(), np.tile(R[0], (2, 1)), atol=1e-6)


def test_apply_names_what_to_do_with_a_path(result, files):
    with pytest.raises(geomoe3d.InputError, match="save_aligned"):
        result.apply(files[0])


# ---- errors --------------------------------------------------------------------------------------------


def test_errors_are_caught_as_the_builtins_that_people_know(tmp_path, files):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        geomoe3d.register(tmp_path / "missing.ply", files[1])
    with pytest.raises(FileNotFoundError, match="cannot read configuration"):
        geomoe3d.load_config(tmp_path / "missing.yaml")
    with pytest.raises(FileNotFoundError, match="no weights"):
        Registrar.from_pretrained(str(tmp_path / "missing.safetensors"))
    with pytest.raises(FileNotFoundError, match="cannot read"):
        load_transform(tmp_path / "missing.txt")
    with pytest.raises(FileNotFoundError, match="cannot read"):
        geomoe3d.register_pairs(tmp_path / "missing.csv", tmp_path / "out")
    with pytest.raises(ValueError, match="shape"):
        geomoe3d.register(np.zeros((5, 2)), files[1])
    assert issubclass(geomoe3d.ForbiddenFileError, PermissionError)
    for name in geomoe3d.__all__:
        kind = getattr(geomoe3d, name)
        if (
            isinstance(kind, type)
            and issubclass(kind, geomoe3d.GeoMoE3DError)
            and kind.__bases__ != (Exception,)
        ):
            assert issubclass(kind, (ValueError, OSError, ImportError))
            assert str(pickle.loads(pickle.dumps(kind("what, value, limit")))) == "what, value, limit"


def test_register_many_goes_on_when_asked_to(files):
    pairs = [(files[0], files[1]), ("missing.ply", files[1]), (files[1], files[0])]
    found = list(Registrar(CONFIG).register_many(pairs, on_error="return"))
    assert [type(one).__name__ for one in found] == [
        "RegistrationResult",
        "MissingFileError",
        "RegistrationResult",
    ]
    with pytest.raises(FileNotFoundError):
        list(Registrar(CONFIG).register_many(pairs))
    with pytest.raises(geomoe3d.InputError, match="raise or return"):
        next(Registrar(CONFIG).register_many(pairs, on_error="skip"))
    for wrong in ("ab", (files[0],), (*files[:2], files[0]), 7):
        with pytest.raises(geomoe3d.InputError, match=r"pair 1 must be \(source, target\)"):
            list(Registrar(CONFIG).register_many([wrong], on_error="return"))


def test_threads_of_one_process_give_the_same_answers(result, files):
    registrar = Registrar(CONFIG)
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda _: registrar.register(*map(str, files)), range(3)))
    for one in found:
        assert one.T_target_source.tobytes() == result.T_target_source.tobytes()
        assert one.confidence == result.confidence


# ---- batches and progress ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(files, tmp_path_factory):
    out = tmp_path_factory.mktemp("batch") / "out"
    pairs = [(str(files[0]), str(files[1])), (str(files[0]), "missing.ply")]
    return geomoe3d.register_pairs(pairs, out, config=CONFIG, cache="", progress=False)


def test_a_batch_is_a_table(report):
    pandas = pytest.importorskip("pandas")
    table = report.table()
    assert isinstance(table, pandas.DataFrame)
    assert list(table.status) == [outcome.status for outcome in report.outcomes]
    assert table.status[1] == "error"
    assert "there is no file" in table.reasons[1]
    np.testing.assert_array_equal(table.T_target_source[0], report.outcomes[0].result.T_target_source)


def test_a_batch_is_a_list_of_rows_without_pandas(report, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    rows = report.table()
    assert [row["id"] for row in rows] == [outcome.id for outcome in report.outcomes]
    assert np.isnan(rows[1]["overlap"])


@progress_module.shows_progress("pairs")
def count_to_three(*, progress=None):
    for done in range(4):
        if progress:
            progress(done, 3)


def test_long_work_shows_progress_unless_told_not_to(capsys, monkeypatch):
    count_to_three()
    assert capsys.readouterr() == ("", "")  # done within a second
    monkeypatch.setattr(progress_module, "_PATIENCE_S", -1.0)
    count_to_three()
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "3 of 3 pairs" in shown.err
    count_to_three(progress=False)
    assert capsys.readouterr() == ("", "")
    told = []
    count_to_three(progress=lambda done, total: told.append((done, total)))
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("shell", "notebook"), [(None, False), (object(), False), (SimpleNamespace(kernel=1), True)]
)
def test_a_notebook_is_where_a_kernel_runs_the_program(shell, notebook, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))  # imported by whomever
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    assert progress_module.on_terminal() == notebook


# ---- the example for robots ----------------------------------------------------------------------------


def load_example(name):
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_node_for_robots_believes_sure_answers_only(result, files):
    module = load_example("ros2_node")
    pose, found = module.Localiser(files[1], least_confidence=0.0, config=CONFIG).locate(np.load(files[0]))
    assert found.T_target_source.tobytes() == result.T_target_source.tobytes()
    assert found.ok
    np.testing.assert_allclose(pose[0], result.T_target_source[:3, 3])
    turned = Rotation.from_quat(pose[1]).as_matrix()
    np.testing.assert_allclose(turned, result.T_target_source[:3, :3], atol=1e-9)
    stricter = module.Localiser(files[1], least_confidence=1.01, config=CONFIG)
    assert stricter.locate(np.load(files[0]))[0] is None
