"""A batch that is called again: changed rows and files, files of the users in its folder, a process that was killed."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from small_scans import SETTINGS, everything, write_table

from geomoe3d import register_pairs
from geomoe3d.batch import contents
from geomoe3d.batch.folder import JOURNAL_FILE, RESULTS_FILE
from geomoe3d.batch.table import MATRIX_COLUMNS, PairRow, read_pairs
from geomoe3d.clouds.transform_files import save_transform
from geomoe3d.config import load_config
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import inverse
from geomoe3d.runtime.files import file_hash
from geomoe3d.runtime.journal import read_journal

CONFIG = load_config(None, SETTINGS)
OPTIONS = [part for setting in SETTINGS for part in ("--set", setting)]
ROOT = Path(__file__).parents[1]


pytestmark = pytest.mark.usefixtures("own_cache")


def test_a_changed_row_or_file_is_done_again_and_the_rest_is_kept(scans, tmp_path):
    folder, _ = scans
    for name in "abc":
        (tmp_path / f"{name}.npy").write_bytes((folder / f"{name}.npy").read_bytes())
    table, out = tmp_path / "pairs.csv", tmp_path / "out"
    write_table(table, [("1", "a", "b"), ("2", "a", "c")])
    register_pairs(table, out, config=CONFIG)
    write_table(table, [("2", "b", "c"), ("1", "a", "b")])
    report = register_pairs(table, out, config=CONFIG)
    assert (report.made, report.kept) == (1, 1)
    assert report.outcomes[0].result.source.name == "b.npy"
    assert [json.loads(line)["id"] for line in (out / RESULTS_FILE).read_text().splitlines()] == ["2", "1"]
    np.save(tmp_path / "a.npy", np.load(tmp_path / "a.npy")[::2])
    report = register_pairs(table, out, config=CONFIG)
    assert (report.made, report.kept) == (1, 1)
    fresh = register_pairs(table, out, config=CONFIG, fresh=True)
    assert (fresh.made, fresh.kept) == (2, 0)


def test_a_batch_gone_on_with_reads_only_files_whose_stamp_changed(scans, tmp_path, monkeypatch):
    for name in "abc":
        (tmp_path / f"{name}.npy").write_bytes((scans[0] / f"{name}.npy").read_bytes())
    table, out = tmp_path / "pairs.csv", tmp_path / "out"
    write_table(table, [("1", "a", "b"), ("2", "a", "c")])
    read, said = [], []

    def noted(path):
        read.append(path.stem)
        return file_hash(path)

    monkeypatch.setattr("geomoe3d.batch.contents.file_hash", noted)
    monkeypatch.setattr("geomoe3d.batch.run.LONG_READ", 0)

    def called():
        read.clear()
        said.clear()
        contents._hash_of.cache_clear()  # as in a new process
        report = register_pairs(table, out, config=CONFIG, say=said.append)
        told = [line for line in said if line.startswith("first reading")]
        assert len(told) == bool(read) and all(f"{len(read)} new or changed file" in line for line in told)
        return report.made, sorted(read)

    assert called() == (2, ["a", "b", "c"])
    assert called() == (0, [])
    path = tmp_path / "c.npy"
    points, status = np.load(path), path.stat()
    np.save(path, points[::-1])
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # neither size nor time tell
    assert called() == (1, ["c"])
    (out / "files.json").write_text('{"format":"geomoe3d batch files 1","files":{"to')
    assert called() == (0, ["a", "b", "c"])
    assert called() == (0, [])


def test_a_gltf_is_another_one_when_its_buffer_changes(tmp_path):
    document = {"asset": {"version": "2.0"}, "buffers": [{"uri": "b%201.bin", "byteLength": 3}]}
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    row = PairRow("1", str(tmp_path / "a.gltf"), str(tmp_path / "none.ply"))
    found = [row.fingerprint(contents.Contents())]
    for text in ("one", "two", "one"):
        (tmp_path / "b 1.bin").write_text(text)
        found.append(row.fingerprint(contents.Contents()))
    assert found[1] == found[3] and len(set(found)) == 3
    (tmp_path / "a.gltf").write_text("damaged")
    assert row.fingerprint(contents.Contents()) not in found


def test_a_glb_with_a_buffer_beside_it_is_another_one_when_that_changes(tmp_path):
    document = json.dumps(
        {"asset": {"version": "2.0"}, "buffers": [{"uri": "b.bin", "byteLength": 3}]}
    ).encode()
    document += b" " * (-len(document) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(document), len(document), 0x4E4F534A)
    (tmp_path / "a.glb").write_bytes(head + document)
    row = PairRow("1", str(tmp_path / "a.glb"), str(tmp_path / "none.ply"))
    found = []
    for text in ("one", "two", "one"):
        (tmp_path / "b.bin").write_text(text)
        found.append(row.fingerprint(contents.Contents()))
    assert found[0] == found[2] != found[1]


def test_killed_in_the_middle_it_goes_on_and_nothing_is_done_twice(scans, tmp_path):
    table, out = tmp_path / "many.csv", tmp_path / "out"
    names = [("a", "b"), ("a", "c"), ("b", "c"), ("b", "a"), ("c", "a"), ("c", "b")]
    for k in range(3):  # by other names, since pairs of the same files are one pair
        for name in "abc":
            shutil.copy(scans[0] / f"{name}.npy", tmp_path / f"{name}{k}.npy")
    lines = [f"{k}-{s}{t},{s}{k}.npy,{t}{k}.npy" for k in range(3) for s, t in names]
    table.write_text("\n".join(["id,source,target", *lines]) + "\n")
    command = [sys.executable, "-m", "geomoe3d", "batch", str(table), str(out), *OPTIONS, "--workers", "1"]
    running = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    journal = out / JOURNAL_FILE
    while time.monotonic() < deadline and (not journal.exists() or journal.read_bytes().count(b"\n") < 3):
        time.sleep(0.02)
    running.kill()
    running.wait()
    before = [record["id"] for record in read_journal(journal)]
    assert 3 <= len(before) < 18
    report = register_pairs(table, out, config=CONFIG)
    assert report.kept == len(before)
    done = [record["id"] for record in read_journal(journal)]
    assert sorted(done) == sorted(line.split(",")[0] for line in lines)
    assert done[: len(before)] == before


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("results.jsonl", {}),
        ("results.csv", {}),
        ("files.json", {}),
        ("journal.jsonl", {}),
        ("run.json", {}),
        ("page.html", {"page": True}),
        ("transforms", {"transforms": True}),
        ("transforms/ab.txt", {"transforms": True}),
    ],
)
@pytest.mark.parametrize("fresh", [False, True])
def test_files_of_the_users_are_not_overwritten(scans, tmp_path, name, named, fresh):
    path = tmp_path / "out" / name
    path.parent.mkdir(parents=True)
    for text in ("mine", '{"identity": {"method": "of something else"}}'):
        path.write_text(text)
        with pytest.raises(InputError, match=rf"{name}' (is not of|does not describe) a batch of geomoe3d"):
            register_pairs(scans[0] / "pairs.csv", tmp_path / "out", config=CONFIG, fresh=fresh, **named)
        assert everything(tmp_path / "out") == {path: text.encode()}


def test_an_id_too_long_for_a_file_name_is_refused_before_work(scans, tmp_path):
    table = tmp_path / "t.csv"
    write_table(table, [("/" * 90, scans[0] / "a", scans[0] / "b")])
    with pytest.raises(InputError, match="a file name of 274 bytes, at most 255"):
        register_pairs(table, tmp_path / "out", config=CONFIG, transforms=True)
    assert not (tmp_path / "out").exists()


def test_first_guesses_from_columns_and_from_files_are_the_same_motion(tmp_path, scans):
    _, poses = scans
    T = inverse(poses["b"]) @ poses["a"]
    for suffix in (".txt", ".npy"):
        save_transform(tmp_path / f"guess{suffix}", T, [])
    cells = ",".join(f"{value:.17g}" for value in T.ravel())
    (tmp_path / "columns.csv").write_text(
        "source,target," + ",".join(MATRIX_COLUMNS) + f"\na,b,{cells}\nc,d" + "," * 16 + "\n"
    )
    with_guess, without = read_pairs(tmp_path / "columns.csv")
    assert np.allclose(with_guess.matrix, T, atol=1e-12)
    assert without.matrix is None
    (tmp_path / "files.csv").write_text("source,target,initial\na,b,guess.txt\nc,d,guess.npy\ne,f,\n")
    rows = read_pairs(tmp_path / "files.csv")
    assert rows[0].initial == rows[1].initial
    assert np.allclose(rows[0].matrix, T, atol=1e-12)
    assert rows[2].initial is None
