"""Where a number comes from: the commit of the code and the machine, for cards, caches and reports."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

from geomoe3d import __version__
from geomoe3d.runtime.words import counted


def source_commit() -> str:
    """Revision of the source that runs, ``-dirty`` where files differ from it, or the installed version."""
    root = Path(__file__).resolve().parents[2]
    if (root / ".git").exists():
        command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
            return done.stdout.strip()
        except (OSError, subprocess.SubprocessError):
            pass
    return f"geomoe3d {__version__}"


def hardware() -> str:
    """Processor, cores and memory in one line."""
    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    except OSError:
        pass
    cores = usable_cores()
    text = f"{model}, {counted(cores, 'core')}"
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return text
    return f"{text}, {size / 2**30:.0f} GiB"


def usable_cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


_NONE = "none"  # a value that only one of two identities has


def differences(stored: dict[str, Any], wanted: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """What differs between two identities (nested plain JSON): name -> (there, now), as JSON or ``none``."""
    old, new = _flat(stored), _flat(wanted)
    return {
        key: (old.get(key, _NONE), new.get(key, _NONE))
        for key in sorted(old.keys() | new.keys())
        if old.get(key) != new.get(key)
    }


def in_words(differing: dict[str, tuple[str, str]], most: int = 3, longest: int = 40) -> str:
    """Differences in one line: the first few, with their values unless long (hashes), and how many more there are.

    What has other values comes before what another version does not know, and before hashes.
    """

    def rank(key: str) -> tuple[bool, bool]:
        return _NONE in differing[key], max(map(len, differing[key])) > longest

    first = sorted(differing, key=rank)[:most]
    told = [key if rank(key)[1] else "{} ({} there, {} now)".format(key, *differing[key]) for key in first]
    rest = len(differing) - len(told)
    return "; ".join(told) + (f"; and in {rest} more" if rest else "")


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, str]:
    rows: dict[str, str] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            rows.update(_flat(value, f"{prefix}{key}."))
        else:
            rows[prefix + key] = json.dumps(value, sort_keys=True)
    return rows
