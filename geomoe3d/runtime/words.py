"""Words for numbers, as all messages and reports write them, and numbers in words, as lists are sorted."""

from __future__ import annotations

import re


def counted(number: int, one: str, many: str | None = None) -> str:
    """``1 pair``, ``1,234 pairs``; ``many`` where it is not ``one`` with an s."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """A key by which scan 2 comes before scan 10."""
    return [
        (0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text) if part
    ]
