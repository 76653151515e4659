"""The clock of the stages: it adds up, and tells each stage as it begins."""

from __future__ import annotations

import pytest

from geomoe3d.runtime.timing import StageClock


def test_the_clock_adds_up_and_tells_each_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter([0.0, 1.0, 3.0, 6.0, 10.0])
    monkeypatch.setattr("geomoe3d.runtime.timing.time.perf_counter", lambda: next(ticks))
    told: list[str] = []
    clock = StageClock(told.append)
    clock("load")
    clock("solve")
    clock("load")
    assert clock.stop() == {"load": 2.0 + 4.0, "solve": 3.0, "total": 10.0}
    assert told == ["load", "solve", "load"]
