"""The highest resident memory of this process while something runs, where the system tells it."""

from __future__ import annotations

from pathlib import Path

_RESET = "5"  # the value by which Linux sets the high-water mark back to the present size


class PeakMemory:
    """Context manager; afterwards ``peak`` is the highest resident size inside it, bytes.

    Everything that the process holds counts, loaded libraries and kept inputs included. None where the
    system does not tell (only Linux does).
    """

    peak: int | None = None

    def __enter__(self) -> PeakMemory:
        try:
            Path("/proc/self/clear_refs").write_text(_RESET, encoding="ascii")
            self._can_reset = True
        except OSError:
            self._can_reset = False
        return self

    def __exit__(self, *error: object) -> None:
        if not self._can_reset:
            return
        try:
            for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
                if line.startswith("VmHWM:"):
                    self.peak = int(line.split()[1]) * 1024
        except (OSError, ValueError):
            self.peak = None
