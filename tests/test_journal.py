"""A journal keeps complete lines through kills, and one writer at a time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest

from geomoe3d.errors import FormatError, InputError, OutputError
from geomoe3d.runtime.journal import Journal, read_journal


def test_records_come_back_in_order(tmp_path):
    path = tmp_path / "a.jsonl"
    records = [{"k": k, "text": "ä\n", "values": [0.1, None]} for k in range(20)]
    with Journal(path) as journal:
        for record in records:
            journal.append(record)
    assert list(read_journal(path)) == records


def test_a_missing_journal_is_empty(tmp_path):
    assert list(read_journal(tmp_path / "none.jsonl")) == []


@pytest.mark.parametrize("torn", [b'{"k": 2', b"x", b'{"k": 2}'])
def test_a_torn_line_is_cut_off_and_written_over(tmp_path, torn):
    path = tmp_path / "a.jsonl"
    path.write_bytes(b'{"k": 0}\n{"k": 1}\n' + torn)
    assert [r["k"] for r in read_journal(path)] == [0, 1]
    with Journal(path) as journal:
        journal.append({"k": 9})
    assert [r["k"] for r in read_journal(path)] == [0, 1, 9]


def test_a_torn_line_longer_than_a_block_is_cut_off(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_bytes(b'{"k": 0}\n{"text": "' + b"x" * 200_000)
    with Journal(path):
        pass
    assert path.read_bytes() == b'{"k": 0}\n'


def test_a_file_that_is_one_torn_line_becomes_empty(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_bytes(b'{"k"')
    with Journal(path) as journal:
        journal.append({"k": 1})
    assert list(read_journal(path)) == [{"k": 1}]


def test_damage_in_the_middle_is_named(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_bytes(b'{"k": 0}\n[1]\n{"k": 2}\n')
    with pytest.raises(FormatError, match="line 2"):
        list(read_journal(path))


def test_nan_is_refused_and_leaves_no_trace(tmp_path):
    path = tmp_path / "a.jsonl"
    with Journal(path) as journal:
        with pytest.raises(ValueError, match="not JSON compliant"):
            journal.append({"x": float("nan")})
        journal.append({"x": 1.0})
    assert list(read_journal(path)) == [{"x": 1.0}]


def test_a_second_writer_is_kept_out(tmp_path):
    path = tmp_path / "a.jsonl"
    with Journal(path), pytest.raises(OutputError, match="another process"):
        Journal(path)
    with Journal(path):
        pass


def test_a_folder_is_no_journal(tmp_path):
    with pytest.raises(OutputError, match="cannot write"):
        Journal(tmp_path)
    with pytest.raises(InputError, match="cannot read"):
        list(read_journal(tmp_path))


def test_what_was_appended_survives_sigkill(tmp_path):
    path = tmp_path / "a.jsonl"
    code = (
        "import sys, time\nfrom geomoe3d.runtime.journal import Journal\n"
        f"journal = Journal({str(path)!r})\n"
        "for k in range(10**9):\n    journal.append({'k': k, 'x': 'y' * 300}); print(k, flush=True)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    for _ in range(50):
        said = process.stdout.readline()
    os.kill(process.pid, signal.SIGKILL)
    said = (process.stdout.read().split() or [said])[-1]
    process.wait()
    kept = [record["k"] for record in read_journal(path)]
    assert kept == list(range(len(kept)))
    assert len(kept) > int(said)
    with Journal(path) as journal:
        journal.append({"k": "after"})
    assert [json.loads(line)["k"] for line in path.read_text().splitlines()] == [*kept, "after"]
