"""Tasks that kill their own process, at module level so that another process finds them."""

from __future__ import annotations

import os
import signal
from pathlib import Path


def die_once(job):
    """Kills its own process the first time that a number is tried."""
    number, folder = job
    mark = Path(folder) / str(number)
    if number % 3 == 0 and not mark.exists():
        mark.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_always(number):
    """Kills its own process whenever the number is 2."""
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number
