"""Torch held to one thread: for the caller alone, and only as long as it lasts."""

from __future__ import annotations

import threading

import pytest
import torch

from geomoe3d.networks.one_thread import single_torch_thread

pytestmark = pytest.mark.usefixtures("one_thread")


def test_one_thread_is_the_callers_own_and_ends() -> None:
    torch.set_num_threads(2)
    seen = []

    def other() -> None:
        with single_torch_thread(), single_torch_thread():
            seen.append(torch.get_num_threads())

    with single_torch_thread():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        seen.append(torch.get_num_threads())
    assert seen == [1, 1]
    assert torch.get_num_threads() == 2
    torch.set_num_threads(1)
