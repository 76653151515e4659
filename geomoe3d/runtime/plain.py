"""Values as JSON knows them."""

from __future__ import annotations

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
