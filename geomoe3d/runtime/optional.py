"""Modules of optional packages, asked for where they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from geomoe3d.errors import DependencyError


def optional_module(name: str, who: str, install: str) -> Any:
    """The module ``name``. Raises DependencyError: it cannot be imported; says who needs what, and the command.

    Args:
        name: to import.
        who: and what it needs, as "E57 files need pye57".
        install: arguments of pip.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise DependencyError(f"{who}, which is not installed: pip install {install} ({error})") from None
