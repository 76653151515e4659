"""Without HOME, without an account and without a place for caches everything works."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from geomoe3d.data.sample import write_sample_pair
from geomoe3d.features.cache import default_cache_folder
from geomoe3d.runtime.home import own_temporary_folder

NOBODY = """
import pwd, sys

def unknown(uid):
    raise KeyError(f"uid not found: {uid}")

pwd.getpwuid = unknown
from geomoe3d.cli.main import main

sys.argv = ["geomoe3d", *sys.argv[1:]]
main()
"""


def run(folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """The command as a user who has neither HOME nor an account."""
    kept = {key: os.environ[key] for key in ("PATH", "LD_LIBRARY_PATH") if key in os.environ}
    environment = {**kept, "PYTHONPATH": str(Path(__file__).parents[1]), **variables}
    return subprocess.run(
        [sys.executable, "-c", NOBODY, *words], cwd=folder, env=environment, capture_output=True, text=True
    )


def test_a_user_without_an_account_gets_everything(tmp_path: Path) -> None:
    (tmp_path / "tmp").mkdir()
    variables = {"TMPDIR": str(tmp_path / "tmp")}
    pair = write_sample_pair(tmp_path / "pair")
    files = [str(pair.source), str(pair.target)]
    outputs = ["--output", "T.txt", "--aligned", "a.ply", "--picture", "p.png", "--page", "p.html"]
    done = run(tmp_path, "register", *files, *outputs, **variables)
    assert done.returncode in (0, 3), done.stderr
    assert "error" not in done.stderr
    assert all((tmp_path / name).stat().st_size for name in outputs[1::2])
    (tmp_path / "pairs.csv").write_text(f"source,target\n{files[0]},{files[1]}\n")
    done = run(tmp_path, "batch", "pairs.csv", "out", "--workers", "1", **variables)
    assert done.returncode in (0, 3), done.stderr
    assert list((tmp_path / "tmp").rglob("*.described.npz"))


def test_a_home_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    for name in ("GEOMOE3D_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "file"))  # nothing can be made in it, by root either
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    own = own_temporary_folder()
    assert own is not None and own.parent == tmp_path and own.stat().st_mode & 0o777 == 0o700
    assert default_cache_folder() == own / "described"
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "file"))
    assert own_temporary_folder() is None
    assert default_cache_folder() == tmp_path / "file" / ".cache" / "geomoe3d" / "described"
