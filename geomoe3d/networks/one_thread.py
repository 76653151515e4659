"""One thread of torch for networks on a thousand correspondences.

Their products are over before a second thread has woken up, and one thread gives the same last bits on any
number of cores; the twin for numpy is `geomoe3d.runtime.threads`. torch keeps the number for each calling
thread, and gives new threads the one that was set last, by whomever: so the caller, who outlives its helpers,
restores it, and helpers never do.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


def helper_keeps_to_one_torch_thread() -> None:
    """For a helper's own thread, inside `single_torch_thread` of the caller whom it helps."""
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Inside, torch uses one thread per operation of the calling thread; may be nested."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
