"""Words for numbers."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from geomoe3d.errors import plain_reason
from geomoe3d.runtime.plain import plain
from geomoe3d.runtime.provenance import differences, in_words
from geomoe3d.runtime.words import counted, of_the_score, shape_in_words


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


def test_a_constant_that_an_earlier_version_did_not_have_is_told_as_one():
    there = {"config": {"expert": {"locating": {}}}, "code": "a" * 64}
    now = {"config": {"expert": {"locating": {"few_places": 12}}}, "code": "b" * 64}
    assert in_words(differences(there, now)) == "code; config.expert.locating.few_places (none there, 12 now)"


def test_what_json_does_not_know_becomes_what_it_knows():
    given = {1: (np.float32(0.5), np.nan, np.arange(2)), "b": [np.bool_(True), float("inf"), None, "x"]}
    assert plain(given) == {"1": [0.5, None, [0, 1]], "b": [True, None, None, "x"]}


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ((), "a single number"),
        ((1,), "1 number"),
        ((3, 1200), "3 rows of 1,200 numbers"),
        ((1, 3), "1 row of 3 numbers"),
        ((4, 5, 3), "a block of 4 x 5 x 3 numbers"),
    ],
)
def test_shapes_in_words(shape, said):
    assert shape_in_words(shape) == said


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (KeyError("points"), "'points' is missing in it"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "it is no text in UTF-8"),
        (
            struct.error("unpack requires a buffer of 4 bytes"),
            "it ends too early, or a number in it is wrong",
        ),
        (
            TypeError("'int' object is not subscriptable"),
            "a value in it is of another kind than belongs there",
        ),
        (ValueError(""), "its content makes no sense"),
    ],
)
def test_reasons_of_libraries_in_plain_words(error, said):
    assert plain_reason(error) == said


@pytest.mark.parametrize("rows", [["1 x"], ["1 2 3", "1 2"]])
def test_what_numpy_says_of_text_is_told_in_plain_words(rows):
    with pytest.raises(ValueError) as caught:
        np.loadtxt(rows)
    assert plain_reason(caught.value) in (
        "'x' in column 2 is no number",
        "a row has 2 numbers, those before it 3",
    )


def test_shares_of_a_score_read_well_at_either_end():
    said = [of_the_score(share) for share in (0.0, 0.004, 0.01, 0.5, 1.0, 1.004, 1.97, 250.0)]
    assert said[:2] == ["under 1 % of the score"] * 2
    assert said[2:6] == ["1 % of the score", "50 % of the score", "100 % of the score", "100 % of the score"]
    assert said[6:] == ["1.97 times the score", "250 times the score"]
