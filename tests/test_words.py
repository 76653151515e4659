"""Words for numbers."""

from __future__ import annotations

import pytest

from geomoe3d.runtime.words import counted


@pytest.mark.parametrize(
    ("number", "said"), [(0, "0 pairs"), (1, "1 pair"), (2, "2 pairs"), (12345, "12,345 pairs")]
)
def test_numbers_of_things(number, said):
    assert counted(number, "pair") == said
    assert counted(number, "match", "matches") == said.replace("pair", "match" if number == 1 else "matche")
