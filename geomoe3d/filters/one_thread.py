"""One thread of torch for networks on a thousand correspondences.

Their products are over before a second thread has woken up, and one thread gives the same last bits on any
number of cores; the twin for numpy is `geomoe3d.threads`. torch keeps the number for each calling thread, so
what is set and restored here is that of the caller alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Inside, torch uses one thread per operation of the calling thread; may be nested."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
