"""From exceptions to exit codes: a message for each, a traceback on demand."""

from __future__ import annotations

import pytest
from command_line import call

from geomoe3d.errors import CheckpointError, ConfigError, DependencyError, EmptyCloudError, OutputError


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (EmptyCloudError("source.xyz holds 2 points; 3 are needed"), 2),
        (ConfigError("no such filter"), 2),
        (DependencyError("pip install this"), 2),
        (CheckpointError("not the same network"), 2),
        (OutputError("cannot write"), 2),
        (RuntimeError("index 5 is out of bounds"), 1),
        (KeyError("gone"), 1),
        (OSError(5, "Input/output error"), 1),
        (MemoryError(), 1),
        (KeyboardInterrupt(), 130),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else str(value),
)
def test_exceptions_become_a_message_and_a_code(error, code, scan_files, fake_registrar, capsys):
    fake_registrar.answer = error
    assert call("register", *scan_files) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "Traceback" not in printed.err
    expected = {1: "fault of geomoe3d", 2: f"error: {error}", 130: "interrupted"}[code]
    assert expected in printed.err
    if code == 1:
        assert "--traceback" in printed.err


def test_traceback_on_demand(scan_files, fake_registrar, monkeypatch, capsys):
    fake_registrar.answer = RuntimeError("broken")
    assert call("register", *scan_files, "--traceback") == 1
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("GEOMOE3D_TRACEBACK", "1")
    assert call("register", *scan_files) == 1
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("GEOMOE3D_TRACEBACK", "0")
    assert call("register", *scan_files) == 1
    assert "Traceback" not in capsys.readouterr().err
