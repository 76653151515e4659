"""The CSV log of a run: it survives a torn line."""

from __future__ import annotations

from pathlib import Path

from geomoe3d.training.logs import CsvLog, read_csv


def test_csv_log_survives_a_torn_line(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    log = CsvLog(path, ["a", "b"], 0)
    log.add(1, {"a": 0.5, "b": 1})
    log.add(2, {"a": 0.25})
    with path.open("a") as file:
        file.write("3,0.")
    CsvLog(path, ["a", "b"], 2).add(3, {"b": 7})
    assert [(r["step"], r["a"], r["b"]) for r in read_csv(path)] == [
        ("1", "0.5", "1"),
        ("2", "0.25", ""),
        ("3", "", "7"),
    ]
