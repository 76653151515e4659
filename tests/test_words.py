"""Words for numbers."""

from __future__ import annotations

import numpy as np
import pytest

from geomoe3d.runtime.plain import plain
from geomoe3d.runtime.provenance import differences, in_words
from geomoe3d.runtime.words import counted


@pytest.mark.parametrize(
    ("number", "said"), [(0, "0 pairs"), (1, "1 pair"), (2, "2 pairs"), (12345, "12,345 pairs")]
)
def test_numbers_of_things(number, said):
    assert counted(number, "pair") == said
    assert counted(number, "match", "matches") == said.replace("pair", "match" if number == 1 else "matche")


def test_what_differs_is_told_without_hashes_and_in_a_few_words():
    stored = {"code": "a" * 64, "parts": {"filter": {"weights": None}}, "seed": 0, "size": 1}
    wanted = {"code": "b" * 64, "parts": {"filter": {"weights": "c" * 64}}, "seed": 1, "size": 3, "added": 4}
    assert in_words(differences(stored, wanted)) == (
        "seed (0 there, 1 now); size (1 there, 3 now); code; and in 2 more"
    )


def test_what_json_does_not_know_becomes_what_it_knows():
    given = {1: (np.float32(0.5), np.nan, np.arange(2)), "b": [np.bool_(True), float("inf"), None, "x"]}
    assert plain(given) == {"1": [0.5, None, [0, 1]], "b": [True, None, None, "x"]}
