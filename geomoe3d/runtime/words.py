"""Words for numbers, as all messages and reports write them, and numbers in words, as lists are sorted."""

from __future__ import annotations

import re
from collections.abc import Sequence


def counted(number: int, one: str, many: str | None = None) -> str:
    """``1 pair``, ``1,234 pairs``; ``many`` where it is not ``one`` with an s."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def of_all(share: float) -> str:
    """``about 15 %``; a share that is nearly none as ``under 1 %``."""
    return f"about {100 * share:.0f} %" if share >= 0.01 else "under 1 %"


def shape_in_words(shape: Sequence[int]) -> str:
    """What an array of a shape holds: ``a single number``, ``3 numbers``, ``3 rows of 500 numbers``."""
    if not shape:
        return "a single number"
    if len(shape) == 1:
        return counted(shape[0], "number")
    if len(shape) == 2:
        return f"{counted(shape[0], 'row')} of {counted(shape[1], 'number')}"
    return f"a block of {' x '.join(f'{count:,}' for count in shape)} numbers"


def once_more(name: str, first: str) -> str:
    """What is said of a file that has the content of another one."""
    return f"'{name}' is '{first}' once more: the files are the same, byte for byte"


def of_the_score(share: float) -> str:
    """How another transform scores beside the answer, the share of its score given, not below zero."""
    if share >= 1.005:
        return f"{share:.3g} times the score"
    return f"{100 * share:.0f} % of the score" if share >= 0.01 else "under 1 % of the score"


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """A key by which scan 2 comes before scan 10."""
    return [
        (0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text) if part
    ]
