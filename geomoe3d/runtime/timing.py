"""Wall time per stage, with a word to whoever watches."""

from __future__ import annotations

import time
from collections.abc import Callable

Progress = Callable[[str], None]


class StageClock:
    """Call it with a stage's name as the stage begins; `stop` gives the seconds of each and ``total``."""

    def __init__(self, progress: Progress | None = None) -> None:
        self._progress = progress
        self._begin = self._last = time.perf_counter()
        self._stage: str | None = None
        self._seconds: dict[str, float] = {}

    def __call__(self, stage: str) -> None:
        """End the running stage, begin the named one, and tell the watcher."""
        self._end()
        self._stage = stage
        if self._progress is not None:
            self._progress(stage)

    def stop(self) -> dict[str, float]:
        """Seconds per stage in order, and ``total``."""
        self._end()
        self._stage = None
        return {**self._seconds, "total": self._last - self._begin}

    def _end(self) -> None:
        now = time.perf_counter()
        if self._stage is not None:
            self._seconds[self._stage] = self._seconds.get(self._stage, 0.0) + now - self._last
        self._last = now
