"""Without HOME, without an account and without a place for caches everything works."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
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
    done = run(tmp_path, "batch", "pairs.csv", "out", "--workers", "2", "--page", **variables)
    assert done.returncode in (0, 3), done.stderr
    (kept,) = {path.parent for path in (tmp_path / "tmp").rglob("*.described.npz")}
    said = [line for line in done.stderr.splitlines() if "warning" in line or "atplotlib" in line]
    assert said == [
        f"warning: this user has no home folder (HOME), so {what} kept in '{folder}'; "
        f"{variable} can name another folder"
        for what, folder, variable in (
            ("descriptions of scans are", kept, "GEOMOE3D_CACHE"),
            ("the list of fonts is", kept.parent / "matplotlib", "MPLCONFIGDIR"),
        )
    ]


def test_a_read_only_root(tmp_path: Path) -> None:
    """The machine's files as a container's that is read only, with one folder to write into."""
    namespace = ["unshare", "--mount", "--map-root-user"]
    if subprocess.run([*namespace, "true"], capture_output=True).returncode:
        pytest.skip("this user may not make a root of his own")
    pair = write_sample_pair(tmp_path / "pair")
    (tmp_path / "out").mkdir()
    script = f"""set -e
        mkdir {tmp_path}/root && mount --rbind / {tmp_path}/root && mount -o remount,ro,bind {tmp_path}/root
        mount -t tmpfs none {tmp_path}/root{tmp_path}/out && mount -t tmpfs none {tmp_path}/root/dev/shm
        printf 'source,target\n{pair.source},{pair.target}\n' > {tmp_path}/root{tmp_path}/out/pairs.csv
        exec chroot {tmp_path}/root bash -c "$1" """
    inside = f"""cd {tmp_path}/out
        ! touch {tmp_path}/file 2>/dev/null || exit 9
        {sys.executable} -m geomoe3d batch pairs.csv out --workers 2 --page || test $? = 3 || exit 1
        test -s out/page.html && test -s out/results.jsonl"""
    environment = {key: value for key, value in os.environ.items() if key not in ("TMPDIR", "XDG_CACHE_HOME")}
    done = subprocess.run(
        [*namespace, "bash", "-c", script, "bash", inside],
        env={**environment, "HOME": "/root", "PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("descriptions of scans are kept in '/dev/shm") == 1, done.stderr
    assert done.stderr.count("so the list of fonts is kept in '/dev/shm") == 1, done.stderr


def test_a_home_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    for name in ("GEOMOE3D_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "file"))  # nothing can be made in it, by root either
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    own = own_temporary_folder()
    assert own is not None and own.parent == tmp_path and own.stat().st_mode & 0o777 == 0o700
    with pytest.warns(RuntimeWarning, match="cannot be made.*are kept in"):
        assert default_cache_folder() == own / "described"
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "file"))
    assert own_temporary_folder() is None
    with pytest.warns(RuntimeWarning, match="descriptions of scans are not kept"):
        assert default_cache_folder() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        assert default_cache_folder() is None
