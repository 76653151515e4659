"""Files appear completely or not at all, and replace nothing by accident."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from geomoe3d.errors import CheckpointError, InputError, OutputError
from geomoe3d.runtime.files import check_output, file_hash, write_atomically, write_text


def names(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def text_writer(text: str):
    def write(path: Path) -> None:
        path.write_text(text)

    return write


def test_writes_with_the_suffix_and_leaves_nothing_else(tmp_path):
    seen = []

    def write(path: Path) -> None:
        seen.append(path)
        path.write_text("points")

    write_atomically(tmp_path / "cloud.ply", write, force=False)
    assert (tmp_path / "cloud.ply").read_text() == "points"
    assert names(tmp_path) == ["cloud.ply"]
    assert seen[0].suffix == ".ply"
    assert seen[0].parent == tmp_path
    assert seen[0].name != "cloud.ply"


@pytest.mark.parametrize("name", ["a.txt", str(Path("a.txt"))])
def test_existing_file_is_kept_without_force_and_replaced_with_it(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path(name).write_text("old")
    called = []
    with pytest.raises(OutputError, match=r"exists.*--force"):
        write_atomically(name, lambda path: called.append(path), force=False)
    assert called == []  # refused before any work
    assert Path(name).read_text() == "old"
    write_atomically(name, text_writer("new"), force=True)
    assert Path(name).read_text() == "new"
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), ValueError("bad"), KeyboardInterrupt()]
)
def test_failure_keeps_the_old_file_and_cleans_up(tmp_path, force, error):
    path = tmp_path / "a.txt"
    if force:
        path.write_text("old")

    def write(temporary: Path) -> None:
        temporary.write_text("half")
        raise error

    with pytest.raises(OutputError if isinstance(error, OSError) else type(error)) as caught:
        write_atomically(path, write, force=force)
    if isinstance(error, OSError):
        assert "No space left" in str(caught.value)
    assert names(tmp_path) == (["a.txt"] if force else [])
    if force:
        assert path.read_text() == "old"


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "a.txt"

    def write(temporary: Path) -> None:
        temporary.write_text("mine")
        path.write_text("theirs")

    with pytest.raises(OutputError, match="force"):
        write_atomically(path, write, force=False)
    assert path.read_text() == "theirs"
    assert names(tmp_path) == ["a.txt"]


def test_missing_folder_folder_as_file_and_device_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for path, words in (
        (tmp_path / "missing" / "a.txt", "does not exist"),
        (tmp_path / "file" / "a.txt", "is not a folder"),
        (tmp_path, "it is a folder"),
        (tmp_path / ("x" * 300), "too long"),
        (Path(os.devnull), "not a regular file"),
    ):
        with pytest.raises(OutputError, match=words):
            write_atomically(path, text_writer("x"), force=True)
    assert sorted(names(tmp_path)) == ["file"]


def test_permissions_follow_the_umask_and_survive_replacement(tmp_path):
    path = tmp_path / "a.txt"
    old = os.umask(0o027)
    try:
        write_atomically(path, text_writer("x"), force=False)
    finally:
        os.umask(old)
    assert path.stat().st_mode & 0o777 == 0o640
    path.chmod(0o604)
    write_atomically(path, text_writer("y"), force=True)
    assert path.stat().st_mode & 0o777 == 0o604


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    with pytest.raises(OutputError, match="exists"):
        check_output(tmp_path / "link.txt", force=False)
    write_atomically(tmp_path / "link.txt", text_writer("new"), force=True)
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_text_is_utf8_with_line_feeds_and_replaces_only_when_told(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "größer\r\n…\n", force=False)
    assert path.read_bytes() == "größer\r\n…\n".encode()
    with pytest.raises(OutputError, match=r"exists.*--force"):
        write_text(path, "new", force=False)
    write_text(path, "new", force=True)
    assert path.read_text() == "new"
    assert names(tmp_path) == ["a.txt"]


def test_text_that_cannot_be_encoded_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "new \ud800", force=True)
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_right_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(OutputError, match="no right"):
            check_output(tmp_path / "a.txt", force=False)
    finally:
        tmp_path.chmod(0o700)


def test_a_hash_is_that_of_all_bytes_and_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    content = bytes(range(256)) * (1 << 17)  # more than one piece
    (tmp_path / "a").write_bytes(content)
    assert file_hash(tmp_path / "a") == hashlib.sha256(content).hexdigest()
    with pytest.raises(InputError, match="cannot read"):
        file_hash(tmp_path / "none")
    with pytest.raises(CheckpointError, match="cannot read"):
        file_hash(tmp_path, CheckpointError)
