"""Pictures: colours, formats and numbers, a wrong transform that looks wrong, no display, hostile names."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from registration_views import NASTY, UTM, make_result, room_view, without_transform
from scipy.spatial.transform import Rotation

from geomoe3d.errors import FormatError, OutputError
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.types import Alternative, CloudReport
from geomoe3d.visual.drawing import build_drawing
from geomoe3d.visual.page import save_page
from geomoe3d.visual.picture import draw_picture, save_picture
from geomoe3d.visual.view import RegistrationView
from geomoe3d.visual.xray import xray

DATA = Path(os.environ.get("GEOMOE3D_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def test_xray_colours_and_orientation():
    rng = np.random.default_rng(0)

    def blob(x, y):
        return np.array([x, y]) + rng.normal(0, 0.02, (400, 2))

    image = xray(
        np.concatenate([blob(0.5, 0.6), blob(-0.5, -0.3)]),
        np.concatenate([blob(-0.6, 0.5), blob(-0.5, -0.3)]),
        np.zeros(2),
        np.array([1.0, 1.0]),
        0.02,
        0.01,
    )
    assert image.shape == (100, 100, 3)
    source, target, both = image[20, 75], image[25, 20], image[65, 25]  # rows run down, y runs up
    assert source[0] > 0.8 and source[2] < 0.3  # orange
    assert target[2] > 0.7 and target[0] < 0.3  # blue
    assert both.max() < 0.4  # dark
    assert (image[90:, 60:] == 1.0).all()  # paper


def dark_shares(figure) -> list[float]:
    """Share of the drawn pixels that are dark, that is, where both clouds lie: before and after."""
    shares = []
    for row in range(2):
        images = [np.asarray(axes.images[0].get_array()) for axes in figure.axes[3 * row : 3 * row + 3]]
        dark = sum((image.max(axis=2) < 0.45).sum() for image in images)
        shares.append(dark / sum((image.min(axis=2) < 0.7).sum() for image in images))
    return shares


def test_right_transform_looks_right_and_wrong_one_looks_wrong():
    view = room_view(num=40_000)
    nudge = make_transform(Rotation.from_euler("z", 4, degrees=True).as_matrix(), np.array([0.2, -0.15, 0.1]))
    wrong = replace(view, result=replace(view.result, T_target_source=nudge @ view.result.T_target_source))
    before, right = dark_shares(draw_picture(view))
    assert dark_shares(draw_picture(wrong))[1] < 0.6 * right
    assert before < 0.4 * right


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".pdf", ".svg"])
def test_picture_formats(tmp_path, suffix):
    path = tmp_path / f"view{suffix}"
    save_picture(room_view(UTM), path)
    start = path.read_bytes()[:300]
    magic = {".png": b"\x89PNG", ".jpg": b"\xff\xd8\xff", ".pdf": b"%PDF", ".svg": b"<svg"}[suffix]
    assert magic in start
    assert 30_000 < path.stat().st_size < 1_500_000
    if suffix == ".png":
        size = int.from_bytes(start[16:20], "big"), int.from_bytes(start[20:24], "big")
        assert size == (1600, 1400)
        save_picture(room_view(UTM), tmp_path / "again.png")
        assert (tmp_path / "again.png").read_bytes() == path.read_bytes()


def picture_text(view: RegistrationView) -> str:
    figure = draw_picture(view)
    texts = [text.get_text() for text in figure.texts]
    for axes in figure.axes:
        texts += [text.get_text() for text in axes.texts]
        texts += [axes.get_title(loc=loc) for loc in ("left", "center", "right")]
        if axes.get_legend():
            texts += [text.get_text() for text in axes.get_legend().get_texts()]
    return "\n".join(texts)


def test_picture_says_the_numbers():
    other = Alternative(np.eye(4), 0.93, 179.5, 1.25)
    result = replace(
        room_view().result,
        status="ambiguous",
        reasons=("a second motion is nearly as good",),
        alternative=other,
        source=CloudReport(NASTY, 1, 0, 0, 0, 1, (0.0, 0.0, 0.0)),
    )
    text = picture_text(
        replace(room_view(UTM), result=replace(result, T_target_source=room_view(UTM).result.T_target_source))
    )
    for words in (
        "ambiguous",
        "confidence 0.90",
        NASTY,
        "target_scan.ply",
        "200 of 300 correspondences",
        "60 %",
        "0.05",
        "1.25",
        "179.5°",
        "a second motion is nearly as good",
        "units apart in the files: drawn side by side",
        "inlier threshold 0.1",
    ):
        assert words in text


def test_picture_without_transform_without_correspondences_and_with_nothing(tmp_path):
    view = room_view()
    lost = picture_text(without_transform(view))
    assert "no transform was found" in lost
    assert "not judged" in lost
    none = replace(view, correspondences=np.zeros((0, 6)))
    assert "no correspondences were given" in picture_text(none)
    empty = replace(without_transform(none), source_points=np.zeros((0, 3)), target_points=np.zeros((0, 3)))
    save_picture(empty, tmp_path / "empty.png")
    # What a registration leaves that failed before anything was chosen, but for an empty transform.
    unknown = {"inlier_threshold": np.nan, "voxel_size": np.nan, "overlap": np.nan, "confidence": np.nan}
    save_picture(replace(view, result=replace(view.result, **unknown)), tmp_path / "unknown.png")
    save_page(replace(view, result=replace(view.result, **unknown)), tmp_path / "unknown.html")
    save_page(empty, tmp_path / "empty.html")
    groups = np.arange(300) % 3
    text = picture_text(replace(view, groups=groups, group_names=("walls", "edges")))
    assert "walls" in text and "edges" in text and "group 2" in text


def test_hostile_names_do_not_stop_the_picture(tmp_path):
    cloud = CloudReport("$\\frac{" + NASTY + "\n漢字" * 40, 1, 0, 0, 0, 1, (0.0, 0.0, 0.0))
    result = replace(room_view().result, source=cloud, target=cloud, reasons=("$\\bad{", "x " * 900))
    save_picture(replace(room_view(), result=result), tmp_path / "a.png")


def test_writers_refuse_what_they_must(tmp_path):
    view = room_view()
    with pytest.raises(FormatError, match=r"\.bmp.*\.png"):
        save_picture(view, tmp_path / "a.bmp")
    for save, name in ((save_picture, "a.png"), (save_page, "a.html")):
        with pytest.raises(OutputError, match="does not exist"):
            save(view, tmp_path / "missing" / name)
        (tmp_path / name).write_text("precious")
        with pytest.raises(OutputError, match="--force"):
            save(view, tmp_path / name)
        assert (tmp_path / name).read_text() == "precious"
        save(view, tmp_path / name, force=True)
        assert (tmp_path / name).stat().st_size > 10_000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.html", "a.png"]


def test_no_display_no_pyplot_and_nothing_heavy_at_import(tmp_path):
    code = """
import sys
import geomoe3d.visual.view, geomoe3d.visual.picture, geomoe3d.visual.page, geomoe3d.visual.window
heavy = {"matplotlib", "open3d", "scipy", "torch", "trimesh"} & set(sys.modules)
assert not heavy, heavy
sys.path.insert(0, sys.argv[1])
from geomoe3d.visual.picture import save_picture
from registration_views import room_view
save_picture(room_view(), sys.argv[2])
assert "matplotlib.pyplot" not in sys.modules
"""
    environment = {
        k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND")
    }
    environment["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code, str(Path(__file__).parent), str(tmp_path / "a.png")],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.png").stat().st_size > 30_000


@pytest.mark.slow
@pytest.mark.real_data
def test_real_kitchen(tmp_path):
    folder = DATA / "fullres"
    if not (folder / "redkitchen_cloud_bin_0.ply").exists():
        pytest.skip(f"real scans not found in {folder}; set GEOMOE3D_DATA")

    def read(name: str) -> np.ndarray:
        raw = (folder / name).read_bytes()
        start = raw.index(b"end_header\n") + 11
        num = int(re.search(rb"element vertex (\d+)", raw[:start]).group(1))
        return np.frombuffer(raw[start : start + 12 * num], "<f4").reshape(num, 3).astype(float)

    lines = (DATA / "3dmatch-dev/benchmarks/3DMatch/7-scenes-redkitchen/gt.log").read_text().splitlines()
    at = next(i for i in range(0, len(lines), 5) if lines[i].split()[:2] == ["0", "4"])
    T = np.array([[float(v) for v in line.split()] for line in lines[at + 1 : at + 5]])
    view = RegistrationView(
        read("redkitchen_cloud_bin_4.ply"),
        read("redkitchen_cloud_bin_0.ply"),
        make_result(T),
        np.zeros((0, 6)),
    )
    assert build_drawing(view, max_points=5000).up_words == "camera, y down"
    figure = draw_picture(view)
    before, after = dark_shares(figure)
    assert after > 2.0 * before
    figure.savefig(tmp_path / "a.png", dpi=100)
    save_page(view, tmp_path / "a.html")
    assert (tmp_path / "a.png").stat().st_size < 1_500_000
    assert (tmp_path / "a.html").stat().st_size < 3_000_000
