"""Pictures, pages and windows show the right thing, from any coordinates, without a display."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from geomoe3d.errors import FormatError, InputError, OutputError
from geomoe3d.geometry.se3 import inverse, make_transform, rotation_angle_deg, transform_points
from geomoe3d.result import Alternative, CloudReport, RegistrationResult
from geomoe3d.visual.page import render_page, save_page
from geomoe3d.visual.picture import draw_picture, save_picture, xray
from geomoe3d.visual.scene import build_scene, distance_to_target, nice_length, thin
from geomoe3d.visual.upright import upright_axes
from geomoe3d.visual.view import RegistrationView
from geomoe3d.visual.window import WindowContent, show_window

UTM = np.array([583394.0, 5283100.0, 498.0])
NASTY = "</script><b>x & {{data}} $\\frac$.ply"
DATA = Path(os.environ.get("GEOMOE3D_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


# ---------------------------------------------------------------- synthetic views


def box_room(num: int, seed: int) -> np.ndarray:
    """Points of a 6 x 4.5 x 2.7 room without a ceiling, with three boxes; z up, walls along x and y."""
    rng = np.random.default_rng(seed)
    planes = [((0, 0, 0), (6, 0, 0), (0, 4.5, 0))]
    for origin, along in (
        ((0, 0, 0), (6, 0, 0)),
        ((0, 4.5, 0), (6, 0, 0)),
        ((0, 0, 0), (0, 4.5, 0)),
        ((6, 0, 0), (0, 4.5, 0)),
    ):
        planes.append((origin, along, (0, 0, 2.7)))
    for x, y, a, b, h in ((1, 1, 1.6, 0.8, 0.75), (4.5, 0.3, 0.6, 1.2, 1.9), (3, 3.2, 1, 1, 0.45)):
        planes.append(((x, y, h), (a, 0, 0), (0, b, 0)))
        planes.append(((x, y, 0), (a, 0, 0), (0, 0, h)))
        planes.append(((x, y, 0), (0, b, 0), (0, 0, h)))
    origins, u, v = (np.array([plane[i] for plane in planes], float) for i in range(3))
    area = np.linalg.norm(np.cross(u, v), axis=1)
    which = rng.choice(len(planes), num, p=area / area.sum())
    points = origins[which] + rng.random((num, 1)) * u[which] + rng.random((num, 1)) * v[which]
    return points + rng.normal(0, 0.005, points.shape)


def make_result(T: np.ndarray, **changes) -> RegistrationResult:
    cloud = CloudReport("scan.ply", 4000, 0, 0, 0, 2000, (0.0, 0.0, 0.0))
    values = {
        "T_target_source": T,
        "status": "ok",
        "reasons": (),
        "confidence": 0.9,
        "overlap": 0.6,
        "evidence": {},
        "num_correspondences": 300,
        "num_inliers": 200,
        "inlier_threshold": 0.1,
        "voxel_size": 0.05,
        "alternative": None,
        "information_matrix": np.eye(6),
        "information_center": np.zeros(3),
        "source": replace(cloud, name="source_scan.ply"),
        "target": replace(cloud, name="target_scan.ply"),
        "seconds": {"match": 0.5, "total": 1.25},
    }
    return RegistrationResult(**{**values, **changes})


def room_view(origin: np.ndarray | None = None, num: int = 4000, **changes) -> RegistrationView:
    """Two overlapping parts of the room; the source turned by 120 degrees, the target moved to ``origin``."""
    rng = np.random.default_rng(3)
    origin = np.zeros(3) if origin is None else origin
    R = Rotation.from_rotvec(np.radians(120) * np.array([0.05, 0.1, 1]) / np.linalg.norm([0.05, 0.1, 1]))
    local = make_transform(R.as_matrix(), np.array([1.0, -2.0, 0.5]))
    T = local.copy()
    T[:3, 3] += origin
    a, b = box_room(num, 1), box_room(num, 2)
    source = transform_points(inverse(local), a[a[:, 0] < 4.4])
    target = b[b[:, 0] > 1.3] + origin
    rows = rng.integers(0, len(source), 300)
    ends = transform_points(local, source[rows]) + rng.normal(0, 0.02, (300, 3)) + origin
    wrong = np.arange(300) >= 200
    ends[wrong] = target[rng.integers(0, len(target), 100)]
    fields = {
        "source_points": source,
        "target_points": target,
        "result": make_result(T),
        "correspondences": np.hstack([source[rows], ends]),
    }
    return RegistrationView(**{**fields, **changes})


def without_transform(view: RegistrationView) -> RegistrationView:
    result = replace(
        view.result, T_target_source=np.full((4, 4), np.nan), status="failed", reasons=("no hypothesis",)
    )
    return replace(view, result=result)


# ---------------------------------------------------------------- the view


def test_residuals_and_kept_follow_the_transform_or_the_weights():
    view = room_view()
    expected = np.linalg.norm(
        view.result.apply(view.correspondences[:, :3]) - view.correspondences[:, 3:], axis=1
    )
    np.testing.assert_allclose(view.residuals(), expected)
    np.testing.assert_array_equal(view.kept(), expected <= 0.1)
    assert view.kept()[:200].mean() > 0.95
    assert view.kept()[200:].mean() < 0.1
    weights = np.linspace(0, 1, 300)
    np.testing.assert_array_equal(replace(view, weights=weights).kept(), weights > 0.5)
    np.testing.assert_array_equal(replace(view, weights=weights, weight_threshold=0.0).kept(), weights > 0)
    lost = without_transform(view)
    assert np.isnan(lost.residuals()).all()
    assert not lost.kept().any()
    assert not lost.has_transform


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"source_points": np.zeros((5, 2))}, r"source_points.*\(N, 3\).*\(5, 2\)"),
        ({"correspondences": np.zeros((5, 3))}, r"correspondences.*\(N, 6\)"),
        ({"weights": np.zeros(299)}, r"weights.*\(300,\).*\(299,\)"),
        ({"weights": np.full(300, 1.5)}, r"weights.*\[0, 1\].*1.5"),
        ({"target_colors": np.full((7, 3), 0.5)}, "target_colors"),
        ({"groups": np.zeros(300)}, "groups.*integers"),
        ({"groups": np.full(300, -1)}, "groups.*negative"),
    ],
)
def test_parts_that_do_not_fit_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        room_view(**changes)


# ---------------------------------------------------------------- upright axes


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


# ---------------------------------------------------------------- the scene


def test_thinning_is_even_seeded_bounded_and_finite():
    rng = np.random.default_rng(0)
    sheet = np.column_stack([rng.random((100_000, 2)) * [0.5, 1.0], np.zeros(100_000)])
    far = np.column_stack([rng.random((5_000, 2)) * [0.5, 1.0] + [0.5, 0], np.zeros(5_000)])
    points = np.concatenate([sheet, far])
    points[::1000] = np.nan
    points[5] = 1e9
    rows = thin(points, 3000, np.random.default_rng(1))
    np.testing.assert_array_equal(rows, thin(points, 3000, np.random.default_rng(1)))
    assert 2400 < len(rows) <= 3000
    assert len(np.unique(rows)) == len(rows)
    assert np.isfinite(points[rows]).all()
    # 5 % of the points cover half of the surface: an even choice gives them far more than their share.
    assert np.mean(rows >= 100_000) > 0.25
    assert len(thin(points, 200_000, np.random.default_rng(1))) == len(points) - 105
    assert len(thin(np.ones((500, 3)), 100, np.random.default_rng(1))) == 1


@pytest.mark.parametrize("origin", [np.zeros(3), UTM])
def test_scene_motions_survive_single_precision(origin):
    view = room_view(origin)
    alternative = Alternative(
        view.result.T_target_source @ make_transform(np.diag([-1.0, -1, 1]), np.zeros(3)), 0.9, 180.0, 1.0
    )
    view = replace(view, result=replace(view.result, alternative=alternative))
    scene = build_scene(view, max_points=2000)
    source = view.source_points[scene.source_rows]
    for motion, T in (
        (scene.after, view.result.T_target_source),
        (scene.alternative, alternative.T_target_source),
    ):
        expected = transform_points(T, source) - scene.target_center
        assert np.abs(expected).max() < 30
        drawn = scene.source.astype(np.float32) @ motion[:3, :3].astype(np.float32).T
        np.testing.assert_allclose(drawn + motion[:3, 3].astype(np.float32), expected, atol=1e-5)
    if origin.any():
        true = np.linalg.norm(scene.source_center - scene.target_center)
        assert scene.apart == pytest.approx(true)
        before = transform_points(scene.before, scene.source)
        assert before.max(axis=0)[0] < scene.target.min(axis=0)[0] + 0.5  # side by side, not on top
        assert np.linalg.norm(before, axis=1).max() < 30
    else:
        assert scene.apart is None
        before = transform_points(scene.before, scene.source) + scene.target_center
        np.testing.assert_allclose(before, source, atol=1e-12)


def test_distance_to_target_against_brute_force():
    view = room_view(UTM, num=1000)
    scene = build_scene(view, max_points=1000)
    found = distance_to_target(view, scene, scene.after, 0.3)
    moved = view.result.apply(view.source_points[scene.source_rows])
    brute = np.linalg.norm(moved[:, None] - view.target_points[None], axis=2).min(axis=1)
    near = brute < 0.3 - 1e-6
    np.testing.assert_allclose(found[near], brute[near], atol=1e-6)
    assert np.isinf(found[brute > 0.3 + 1e-6]).all()
    assert 0.1 < near.mean() < 1.0


@pytest.mark.parametrize(
    ("length", "nice"), [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (49.0, 20.0), (0.07, 0.05)]
)
def test_nice_length(length, nice):
    assert nice_length(length) == pytest.approx(nice)


# ---------------------------------------------------------------- the picture


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
        "60%",
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
from test_visual import room_view, save_picture
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


# ---------------------------------------------------------------- the page as a file


class Page(HTMLParser):
    """Elements, their attributes and the text in them, as a browser would split them."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"</{tag}> does not close what is open"

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))

    def data(self) -> dict:
        return json.loads(max((text for tag, text in self.texts if tag == "script"), key=len))


def decode(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype=kind)


def nasty_view() -> RegistrationView:
    view = room_view(UTM)
    cloud = CloudReport(NASTY, 1, 0, 0, 0, 1, (0.0, 0.0, 0.0))
    half_turn, middle = np.diag([-1.0, -1, 1]), view.target_points.mean(axis=0)
    turned = make_transform(half_turn, middle - half_turn @ middle) @ view.result.T_target_source
    result = replace(
        view.result,
        source=cloud,
        target=replace(cloud, name='"><img src=x onerror=alert(1)>'),
        status="ambiguous",
        reasons=("<i>reason</i> & </script><script>alert(1)</script>",),
        alternative=Alternative(turned, 0.9, 180.0, 0.3),
    )
    return replace(
        view,
        result=result,
        groups=np.arange(300) % 2,
        group_names=("</script><script>alert(2)</script>", "<b>plain</b>"),
        source_colors=np.random.default_rng(0).random((len(view.source_points), 3)),
    )


def test_page_keeps_user_text_as_text_and_asks_no_network():
    text = render_page(nasty_view())
    page = Page(text)
    assert page.open == []
    tags = [tag for tag, _ in page.elements]
    assert tags.count("script") == 3
    assert "img" not in tags and "i" in tags  # the only <i> is the page's own colour scale
    joined = "".join(data for tag, data in page.texts if tag not in ("script", "style"))
    for words in (
        NASTY,
        '"><img src=x onerror=alert(1)>',
        "<i>reason</i> & </script><script>alert(1)</script>",
    ):
        assert words in joined
    assert page.data()["lines"]["classes"][0]["label"] == "</script><script>alert(2)</script>"
    for tag, attributes in page.elements:
        assert not {"src", "href", "action", "srcset", "data"} & set(attributes), (tag, attributes)
        assert not any(name.startswith("on") for name in attributes)
    policy = next(a["content"] for t, a in page.elements if t == "meta" and "http-equiv" in a)
    assert policy.startswith("default-src 'none'")
    for word in (
        "http://",
        "https://",
        "@import",
        "url(",
        "fetch(",
        "XMLHttpRequest",
        "innerHTML",
        "{{title}}",
    ):
        assert word not in text
    labels = {a["id"] for _, a in page.elements if "id" in a}
    assert len(labels) == sum("id" in a for _, a in page.elements)  # ids are unique


def test_page_data_are_the_clouds_and_the_answer():
    view = nasty_view()
    data = Page(render_page(view)).data()
    scene = build_scene(view, max_points=50_000)
    source = decode(data["source"]["points"], "<f4").reshape(-1, 3)
    assert len(source) == len(view.source_points)
    after = np.array(data["motions"]["answer"]).reshape(4, 4)
    there = transform_points(after, source.astype(float)) + scene.target_center
    np.testing.assert_allclose(there, view.result.apply(view.source_points), atol=1e-5)
    target = decode(data["target"]["points"], "<f4").reshape(-1, 3) + scene.target_center
    np.testing.assert_allclose(target, view.target_points, atol=1e-5)
    colors = decode(data["source"]["colors"], "u1").reshape(-1, 3)
    np.testing.assert_allclose(colors / 255.0, view.source_colors, atol=0.5 / 255 + 1e-9)
    assert data["target"]["colors"] is None
    for name, T in (
        ("answer", view.result.T_target_source),
        ("alternative", view.result.alternative.T_target_source),
    ):
        copied = np.array([[float(v) for v in line.split()] for line in data["matrices"][name].splitlines()])
        np.testing.assert_array_equal(copied, T)  # every bit
    assert data["distanceLimit"] == 2 * view.result.inlier_threshold
    for name, motion in (("answer", scene.after), ("alternative", scene.alternative)):
        distance = distance_to_target(view, scene, motion, data["distanceLimit"])
        levels = decode(data["distances"][name], "u1")
        np.testing.assert_allclose(
            levels, np.minimum(255 * distance / data["distanceLimit"], 255), atol=0.501
        )
        assert len(np.unique(levels)) > 50
    lines = decode(data["lines"]["vertices"], "<f4").reshape(-1, 2, 3)
    assert [(kind["total"], kind["drawn"]) for kind in data["lines"]["classes"]] == [(150, 150), (150, 150)]
    moved = transform_points(after, lines[:, 0].astype(float))
    length = np.linalg.norm(moved - lines[:, 1], axis=1)
    np.testing.assert_allclose(np.sort(length), np.sort(view.residuals()), atol=1e-4)


def test_page_is_small_and_repeatable(tmp_path):
    rng = np.random.default_rng(0)
    num = 100_000
    points = rng.random((num, 3)) * [30, 20, 3]
    matches = points[rng.integers(0, num, 20_000)]
    view = RegistrationView(
        points,
        points + UTM,
        make_result(make_transform(np.eye(3), UTM), alternative=Alternative(np.eye(4), 0.5, 0.0, 9.0)),
        np.hstack([matches, matches + UTM + rng.normal(0, 0.1, matches.shape)]),
        source_colors=rng.random((num, 3)),
        target_colors=rng.random((num, 3)),
    )
    save_page(view, tmp_path / "a.html")
    assert (tmp_path / "a.html").stat().st_size < 3_000_000
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert re.search(r"Drawn: 4\d,\d\d\d of 100,000 source points", text)
    assert render_page(room_view()) == render_page(room_view())


# ---------------------------------------------------------------- the page in a browser


def chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome", "chrome"):
        found = shutil.which(name)
        if found:
            return found
    message = "no Chromium found (chromium, chromium-browser, google-chrome): the page cannot be tried"
    if os.environ.get("CI", "").lower() == "true":
        pytest.fail(message)
    pytest.skip(message)


# Frames by timers: under virtual time a browser without a screen may never call for a frame.
BEFORE = "<script>window.requestAnimationFrame = (f) => setTimeout(() => f(performance.now()), 16);</script>"


def browse(
    tmp_path: Path, text: str, *, script: str = "", webgl: bool = True, wish: str = ""
) -> dict[str, str]:
    """Open a page in headless Chromium, run a script in it and return the data attributes of its body."""
    path = tmp_path / "page.html"
    assert text.count("<title>") == 1 and text.count("</body>") == 1
    extra = f"<script>{script}</script></body>" if script else "</body>"
    path.write_text(text.replace("<title>", BEFORE + "<title>").replace("</body>", extra), encoding="utf-8")
    graphics = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    done = subprocess.run(
        [
            chromium(),
            "--headless",
            "--no-sandbox",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--window-size=760,560",
            "--virtual-time-budget=20000",
            *(graphics if webgl else ["--disable-gpu", "--disable-3d-apis"]),
            "--dump-dom",
            path.as_uri() + ("#" + wish if wish else ""),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    body = re.search(r"<body[^>]*>", done.stdout)
    assert body, f"Chromium gave no page: {done.stderr[-2000:]}"
    return {k: html.unescape(v) for k, v in re.findall(r'data-([\w-]+)="([^"]*)"', body.group(0))}


# Uses the page as a person would and notes what it says it drew after each step.
USE = r"""
(async () => {
  const body = document.body, byId = (id) => document.getElementById(id), stage = byId("stage"), log = {};
  stage.setPointerCapture = () => {};
  const settle = () => new Promise((done) => setTimeout(done, 100));
  const note = async (name) => { await settle(); log[name] = { ...body.dataset }; };
  const send = (Kind, name, more) => stage.dispatchEvent(new Kind(name, { bubbles: true, ...more }));
  const key = (key, more) => send(KeyboardEvent, "keydown", { key, ...more });
  const pointer = (kind, pointerId, clientX) =>
    send(PointerEvent, "pointer" + kind, { pointerId, clientX, clientY: 200, buttons: 1 });
  const slide = (id, value) => { byId(id).value = value; byId(id).dispatchEvent(new Event("input")); };
  await note("start");
  for (const at of [0, 0.25, 0.5, 1]) { slide("progress", at); await note("at" + at); }
  key("ArrowLeft"); await note("turned");
  key("ArrowUp", { shiftKey: true }); await note("moved");
  key("+"); await note("zoomed");
  key("1"); await note("top");
  pointer("down", 1, 100); pointer("move", 1, 150); pointer("up", 1, 150); await note("dragged");
  pointer("down", 1, 100); pointer("down", 2, 200); pointer("move", 2, 300); await note("pinched");
  pointer("up", 1, 0); pointer("up", 2, 0);
  send(WheelEvent, "wheel", { deltaY: 50, cancelable: true }); await note("wheeled");
  byId("show-source").click(); await note("hidden");
  byId("show-source").click();
  byId("classes").querySelector("input").click(); await note("lines");
  document.querySelector('[name="color"][value="distance"]').click();
  document.querySelector('[name="motion"][value="alternative"]').click();
  await note("alternative");
  key(" "); await note("playing"); key(" ");
  const clipboard = { writeText: async (text) => { log.copied = text; } };
  Object.defineProperty(navigator, "clipboard", { value: clipboard });
  document.querySelector('[data-copy="answer"]').click(); await settle();
  log.wronglyMade = document.querySelectorAll("b:not(.names b), img").length;
  body.dataset.log = JSON.stringify(log);
})().catch((problem) => { document.body.dataset.error = "script: " + problem; });
"""


def model(entry: dict[str, str]) -> np.ndarray:
    return np.array([float(v) for v in entry["model"].split()]).reshape(4, 4).T


def camera(entry: dict[str, str]) -> np.ndarray:
    return np.array([float(v) for v in entry["camera"].split()])


@pytest.mark.parametrize("webgl", [True, False], ids=["webgl2", "canvas2d"])
def test_page_in_a_browser(tmp_path, webgl):
    view = nasty_view()
    seen = browse(tmp_path, render_page(view), script=USE, webgl=webgl)
    assert "error" not in seen, seen["error"]
    assert seen["ready"] == "true"
    assert seen["renderer"] == ("webgl2" if webgl else "canvas2d")
    log = json.loads(seen["log"])
    num = len(view.source_points) + len(view.target_points)
    assert log["start"]["drawnPoints"] == str(num)
    assert log["start"]["drawnLines"] == "300"
    assert 0.03 < float(log["start"]["covered"]) < 0.9
    assert log["hidden"]["drawnPoints"] == str(len(view.target_points))
    assert log["lines"]["drawnLines"] == "150"
    assert log["wronglyMade"] == 0
    np.testing.assert_array_equal(
        np.array(log["copied"].split(), dtype=float).reshape(4, 4), view.result.T_target_source
    )

    # The slider moves the source rigidly: spherical interpolation, about the source's own middle.
    scene = build_scene(view, max_points=50_000)
    path = Slerp([0, 1], Rotation.from_matrix([scene.before[:3, :3], scene.after[:3, :3]]))
    for at in (0, 0.25, 0.5, 1):
        expected = make_transform(
            path(at).as_matrix(), (1 - at) * scene.before[:3, 3] + at * scene.after[:3, 3]
        )
        np.testing.assert_allclose(model(log[f"at{at}"]), expected, atol=1e-9)
    np.testing.assert_allclose(model(log["alternative"]), scene.alternative, atol=1e-9)
    assert rotation_angle_deg(model(log["playing"])[:3, :3].T @ scene.alternative[:3, :3]) > 0.5

    yaw, pitch, distance = range(3)
    start, turned, moved = camera(log["at1"]), camera(log["turned"]), camera(log["moved"])
    assert turned[yaw] != start[yaw] and np.array_equal(turned[1:], start[1:])
    assert np.array_equal(moved[:3], turned[:3]) and not np.array_equal(moved[3:], turned[3:])
    assert camera(log["zoomed"])[distance] == pytest.approx(0.87 * moved[distance], rel=1e-4)
    top = camera(log["top"])
    assert top[pitch] == pytest.approx(np.pi / 2, rel=1e-5)
    np.testing.assert_allclose(top[3:], start[3:])
    assert camera(log["dragged"])[yaw] == pytest.approx(-50 * 0.007, rel=1e-4)
    assert camera(log["pinched"])[distance] == pytest.approx(top[distance] / 2, rel=1e-3)
    assert camera(log["wheeled"])[distance] > camera(log["pinched"])[distance]


def test_page_without_transform_shows_only_before(tmp_path):
    view = without_transform(room_view())
    text = render_page(view)
    assert "No transform was found" in text
    assert "data-copy" not in "".join(str(attributes) for _, attributes in Page(text).elements)
    script = "document.body.dataset.locked = document.getElementById('progress').disabled"
    seen = browse(tmp_path, text, script=script, wish="at=1&renderer=canvas2d&color=distance")
    assert "error" not in seen
    assert seen["locked"] == "true"
    assert seen["drawn-points"] == str(len(view.source_points) + len(view.target_points))
    scene = build_scene(view, max_points=50_000)
    np.testing.assert_allclose(model(seen), scene.before, atol=1e-9)


# ---------------------------------------------------------------- the window


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="displays are found by environment on Linux only"
)
def test_window_without_display_says_so(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(OutputError, match=r"no display.*\.html"):
        show_window(room_view())
    monkeypatch.setenv("WAYLAND_DISPLAY", "no-such-socket")
    with pytest.raises(OutputError, match="nothing answers at WAYLAND_DISPLAY=no-such-socket"):
        show_window(room_view())


def test_window_content_switches():
    pytest.importorskip("open3d", exc_type=ImportError)
    view = nasty_view()
    scene = build_scene(view, max_points=1000)
    content = WindowContent(replace(view, groups=None), scene)

    def source():
        return np.asarray(content.source.points)

    def colors():
        return np.asarray(content.source.colors)

    assert len(content.geometries()) == 3
    np.testing.assert_allclose(source(), transform_points(scene.after, scene.source))
    lengths = np.linalg.norm(np.diff(np.asarray(content.lines.points).reshape(2, -1, 3), axis=0)[0], axis=1)
    assert lengths.max() <= view.result.inlier_threshold  # only agreeing ones, and they are in place
    assert len(np.unique(colors(), axis=0)) == 1
    content.switch_stage()
    np.testing.assert_allclose(source(), transform_points(scene.before, scene.source))
    content.switch_alternative()
    np.testing.assert_allclose(source(), transform_points(scene.alternative, scene.source))
    content.switch_alternative()
    np.testing.assert_allclose(source(), transform_points(scene.after, scene.source))
    content.switch_colors()
    np.testing.assert_allclose(colors(), view.source_colors[scene.source_rows])
    content.switch_lines()
    pairs = np.asarray(content.lines.lines)
    assert len(pairs) and (pairs[:, 0] == pairs[:, 1]).all()
    lost = without_transform(replace(view, groups=None, correspondences=np.zeros((0, 6))))
    content = WindowContent(lost, build_scene(lost, max_points=1000))
    content.switch_stage()
    content.switch_alternative()
    assert len(content.geometries()) == 2
    np.testing.assert_allclose(source(), transform_points(scene.before, scene.source))


# ---------------------------------------------------------------- real scans


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
    assert build_scene(view, max_points=5000).up_words == "camera, y down"
    figure = draw_picture(view)
    before, after = dark_shares(figure)
    assert after > 2.0 * before
    figure.savefig(tmp_path / "a.png", dpi=100)
    save_page(view, tmp_path / "a.html")
    assert (tmp_path / "a.png").stat().st_size < 1_500_000
    assert (tmp_path / "a.html").stat().st_size < 3_000_000
