"""Open3D's compiled half, without the Python around it.

``import open3d`` also imports a web server, a plotter and a notebook, which windows need and registration
does not: 0.5 s of processor time and 967 modules against 0.2 s and 218. What is loaded here is the very
module that Open3D imports itself (``open3d.pybind``), so a program that imports Open3D before or after gets
all of it, and the same types.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import threading
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

_NAME = "open3d.pybind"
_lock = threading.Lock()


def open3d_core() -> Any:
    """Open3D, or what of it registration needs: ``geometry``, ``utility``, ``pipelines``, ``t`` and ``core``.
    Raises ImportError: Open3D is not installed."""
    with _lock:
        if "open3d" not in sys.modules and (_NAME in sys.modules or _load()):
            return sys.modules[_NAME]
        import open3d

        return open3d


def _load() -> bool:
    """Load the compiled half; False where it is to be had in the usual way alone."""
    spec = importlib.util.find_spec("open3d")
    if (
        spec is None or spec.origin is None or sys.platform == "win32"
    ):  # there Open3D says where libraries lie
        return False
    places = [Path(spec.origin).with_name(f"pybind{suffix}") for suffix in EXTENSION_SUFFIXES]
    found = next((place for place in places if place.is_file()), None)
    compiled = None if found is None else importlib.util.spec_from_file_location(_NAME, found)
    if compiled is None or compiled.loader is None:
        return False
    os.environ["TCM_ENABLE"] = "1"  # as Open3D does: its threads and others' share one pool
    try:
        module = importlib.util.module_from_spec(compiled)
        sys.modules[_NAME] = module
        compiled.loader.exec_module(module)
    except ImportError:
        sys.modules.pop(_NAME, None)
        return False
    return True
