"""One thread for the many small matrix products of a registration.

Products of some hundred rows are over before a second thread has woken up; on a machine whose cores have
other work, waiting for it made solving four times slower. One thread also gives the same last bits on any
number of cores. Large products (matching of large clouds) and torch keep theirs.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

_lock = threading.Lock()
_depth = 0
_limits: Any = None


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Inside, BLAS calls of this process use one thread; also a decorator; may be nested, and entered
    by several threads at once: the last one out restores what was set before the first one came in."""
    global _depth, _limits
    with _lock:
        if _depth == 0:
            _limits = _controller().limit(limits=1, user_api="blas")
        _depth += 1
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            if _depth == 0:
                _limits.restore_original_limits()
                _limits = None


@lru_cache(maxsize=1)
def _controller() -> Any:
    """The libraries found once: looking for them takes 4 ms, which is much beside a small product."""
    import scipy.linalg  # noqa: F401 - brings a BLAS of its own, which must be there to be found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
