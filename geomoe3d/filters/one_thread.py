"""One thread of torch for networks on a thousand correspondences.

Their products are over before a second thread has woken up, and one thread gives the same last bits on any
number of cores; the twin for numpy is `geomoe3d.threads`.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_lock = threading.Lock()
_depth = 0
_before = 1


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Inside, torch uses one thread per operation; may be nested, and entered by several threads at once:
    the last one out restores what was set before the first one came in."""
    global _depth, _before
    with _lock:
        if _depth == 0:
            _before = torch.get_num_threads()
            torch.set_num_threads(1)
        _depth += 1
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            if _depth == 0:
                torch.set_num_threads(_before)
