"""The docs: the site builds without a warning, code runs, options exist, links lead somewhere, lines are short."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from small_scans import CUTS, cut, scene

import geomoe3d
from geomoe3d.cli.errors import run
from geomoe3d.cli.main import geomoe3d as program
from geomoe3d.data.sample import write_sample_pair

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
OURS = [DOCS / "quickstart.md", *sorted(DOCS.glob("how-to/*.md"))]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]


def blocks(page, *languages):
    return re.findall(
        rf"^```(?:{'|'.join(languages)})\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE
    )


def name_of(page):
    return str(page.relative_to(ROOT))


def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("material")
    pytest.importorskip("mkdocstrings")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    reference = (tmp_path / "site" / "api" / "index.html").read_text()
    for name in ("register_many", "save_aligned", "MissingFileError", "information_center"):
        assert name in reference
    assert "fonts.googleapis" not in reference


@pytest.fixture(scope="module")
def thin_sample(tmp_path_factory):
    """The pair of `geomoe3d sample`, every third point."""
    folder = tmp_path_factory.mktemp("sample")
    paths = write_sample_pair(folder)
    for path in (paths.source, paths.target):
        geomoe3d.save_points(path, geomoe3d.load_points(path).file_points[::3], force=True)
    return paths


def write_inputs(folder, paths, page):
    """What the code of a page finds in the folder in which it runs."""
    (folder / "sample").mkdir()
    for place in (folder, folder / "sample"):
        for path in (paths.source, paths.target):
            (place / path.name).symlink_to(path)
    if "model.stl" in page.read_text():
        import trimesh

        boxes = []
        rng = np.random.default_rng(0)
        for _ in range(12):
            turn = trimesh.transformations.random_rotation_matrix(rng.random(3))
            box = trimesh.creation.box(rng.uniform(0.3, 1.2, 3), turn)
            boxes.append(box.apply_translation(rng.uniform(0, 4, 3)))
        mesh = trimesh.util.concatenate(boxes)
        mesh.export(folder / "model.stl")
        (folder / "source.ply").unlink()
        points = trimesh.sample.sample_surface(mesh, 20_000, seed=1)[0]
        geomoe3d.save_points(folder / "source.ply", points[points[:, 0] < 3])
    if '"scans"' in page.read_text():
        (folder / "scans").mkdir()
        for number, (low, high) in enumerate(CUTS[:3]):
            np.save(folder / "scans" / f"{number}.npy", cut(scene(), low, high, seed=number)[0])


@pytest.mark.parametrize("page", OURS[1:], ids=name_of)
def test_python_in_the_docs_runs(page, thin_sample, tmp_path, monkeypatch):
    code = blocks(page, "python")
    if not code:
        pytest.skip("no Python on this page")
    write_inputs(tmp_path, thin_sample, page)
    monkeypatch.chdir(tmp_path)
    exec(compile("\n".join(code), page.name, "exec"), {"__name__": "docs"})


def test_readme_and_quickstart_run_one_after_the_other_in_an_empty_folder(tmp_path, monkeypatch, capfd):
    """Every command, then the Python, of both pages in turn; a name given twice would be a refusal to overwrite."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "docs"}
    for page in (ROOT / "README.md", DOCS / "quickstart.md"):
        for words in commands(page):
            if words != ["doctor"]:
                assert run(program, "geomoe3d", words) == 0, (words, capfd.readouterr().err)
        exec(compile("\n".join(blocks(page, "python")), page.name, "exec"), names)
        assert names["result"].ok and names["moved"].shape[1] == 3
    for made in ("T.txt", "aligned.ply", "page.html", "pose.tum", "both.png", "room.map", "model/poses.json"):
        assert Path(made).is_file(), made


@pytest.mark.parametrize("page", OURS, ids=name_of)
def test_no_page_writes_one_file_twice(page):
    options = {"--output", "--aligned", "--picture", "--page", "--report"}
    written = [
        words[k + 1]
        for words in commands(page)
        for k, word in enumerate(words[:-1])
        if word in options and "--force" not in words
    ]
    assert len(written) == len(set(written)), written


def commands(page):
    for block in blocks(page, "bash", "sh", "console"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["geomoe3d"]:
                yield words[1:]


@pytest.mark.parametrize("page", [page for page in PAGES if "geomoe3d " in page.read_text()], ids=name_of)
def test_commands_in_the_docs_have_the_options_that_they_name(page):
    for words in commands(page):
        command, context = program, click.Context(program, info_name="geomoe3d", **program.context_settings)
        while isinstance(command, click.Group) and words and not words[0].startswith("-"):
            command = command.get_command(context, words[0])
            assert command is not None, words
            words = words[1:]
        if not {"--help", "--version"} & set(words):
            command.make_parser(context).parse_args(list(words))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        if not link.startswith("http"):
            assert (page.parent / link).exists(), link


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_lines_are_short(page):
    """Those of tables and of code cannot be broken."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    lines = [line for line in text.splitlines() if not line.startswith(("|", "    "))]
    assert not [line for line in lines if len(line) > 120]


def test_the_picture_of_the_readme_is_small():
    picture = DOCS / "images" / "registration.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size < 200_000
    assert "(docs/images/registration.png)" in (ROOT / "README.md").read_text()
