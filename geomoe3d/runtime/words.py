"""Words for numbers, as all messages and reports write them."""

from __future__ import annotations


def counted(number: int, one: str, many: str | None = None) -> str:
    """``1 pair``, ``1,234 pairs``; ``many`` where it is not ``one`` with an s."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"
