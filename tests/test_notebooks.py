"""The examples that are notebooks too, run as such in an empty folder; and the gallery that they draw."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from cloud_files import needed

ROOT = Path(__file__).parents[1]
NOTEBOOKS = [path for path in sorted((ROOT / "examples").glob("*.py")) if "# %%" in path.read_text()]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_an_example_runs_as_a_notebook(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jupytext, nbclient = needed("jupytext"), needed("nbclient")
    needed("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = jupytext.read(path)
    kinds = [cell.cell_type for cell in notebook.cells]
    assert kinds[0] == "markdown" and kinds.count("code") >= 3
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    assert (tmp_path / f"{path.stem}.png").stat().st_size > 10_000
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in shown if output.get("name") == "stderr"]
    if path.stem == "two_scans":
        assert any("text/html" in output.get("data", {}) for output in shown)


def test_the_gallery_shows_what_the_examples_draw() -> None:
    text = (ROOT / "docs" / "gallery.md").read_text()
    pictures = re.findall(r"\(images/gallery_(\w+)\.png\)", text)
    assert sorted(pictures) == sorted(path.stem for path in NOTEBOOKS)
    for name in pictures:
        assert f"(../examples/{name}.py)" in text
        assert 10_000 < (ROOT / "docs" / "images" / f"gallery_{name}.png").stat().st_size < 200_000
