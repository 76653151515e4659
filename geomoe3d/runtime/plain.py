"""Values as JSON knows them, and as they are read from it: every reader of JSON asks here."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, is_dataclass
from typing import Any


def plain(value: Any) -> Any:
    """Records as dictionaries, tuples as lists, arrays and numbers of numpy as Python's, what is not finite as None,
    else text."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    as_python: Callable[[], Any] | None = getattr(value, "tolist", None)
    return plain(as_python()) if as_python is not None else str(value)


def parse_json(text: str | bytes, *, parse_int: Callable[[str], Any] | None = None) -> Any:
    """As `json.loads`. Raises ValueError, mostly a `json.JSONDecodeError`: the text is no JSON, is nested too
    deeply, or has a whole number of too many digits."""
    try:
        return json.loads(text, parse_int=parse_int)
    except RecursionError:
        raise ValueError("its brackets are nested too deeply") from None
    except ValueError as error:
        if type(error) is ValueError:  # of Python's limit on digits
            raise ValueError("a number in it has too many digits") from None
        raise
