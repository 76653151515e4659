"""The questions that `doctor` asks of a machine, each answered without importing anything heavy.

Python's standard library alone; libraries are imported in a process of their own, so that one which
crashes takes nothing with it. A class, so that tests can put other machines in its place.
"""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata


@dataclass(frozen=True)
class ImportOutcome:
    """How an import in a process of its own ended: what it printed, or its last line of complaint."""

    ok: bool
    text: str


class Machine:
    """The questions the doctor asks; tests answer them differently."""

    def system(self) -> str:
        """`linux` or `darwin`."""
        return sys.platform

    def architecture(self) -> str:
        """`x86_64`, `aarch64`, ..."""
        return platform.machine()

    def family(self) -> str:
        """`debian` (also Ubuntu), `fedora` (also Red Hat), or empty where unknown."""
        try:
            release = platform.freedesktop_os_release()
        except (OSError, AttributeError):
            return ""
        names = f"{release.get('ID', '')} {release.get('ID_LIKE', '')}".split()
        if {"debian", "ubuntu"} & set(names):
            return "debian"
        return "fedora" if {"fedora", "rhel"} & set(names) else ""

    def python(self) -> tuple[int, int, int]:
        """Version of the running interpreter."""
        return sys.version_info[:3]

    def executable(self) -> str:
        """Path of the running interpreter."""
        return sys.executable

    def glibc(self) -> tuple[int, int] | None:
        """Version of glibc, or None where the C library is another one."""
        try:
            name, version = str(os.confstr("CS_GNU_LIBC_VERSION")).split()
            major, minor = version.split(".")[:2]
            return (int(major), int(minor)) if name == "glibc" else None
        except (AttributeError, ValueError, OSError):
            return None

    def is_root(self) -> bool:
        """Whether packages can be installed without sudo."""
        return hasattr(os, "geteuid") and os.geteuid() == 0

    def loads(self, soname: str) -> bool:
        """Whether the dynamic linker finds a shared library."""
        try:
            ctypes.CDLL(soname)
        except OSError:
            return False
        return True

    def version(self, distribution: str) -> str | None:
        """Version of an installed Python distribution, None where it is not installed."""
        try:
            return metadata.version(distribution)
        except metadata.PackageNotFoundError:
            return None

    def run_import(self, code: str) -> ImportOutcome:
        """Run a few statements in a fresh interpreter."""
        try:
            done = subprocess.run(
                [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
            )
        except subprocess.TimeoutExpired:
            return ImportOutcome(False, "no answer within 120 s")
        if done.returncode == 0:
            return ImportOutcome(True, done.stdout.strip())
        if done.returncode < 0:
            return ImportOutcome(False, f"the process died of signal {-done.returncode} during import")
        lines = done.stderr.strip().splitlines()
        return ImportOutcome(False, lines[-1] if lines else f"exit code {done.returncode}")

    def register_on_path(self) -> str | None:
        """Where the shell finds `register`, or None."""
        return shutil.which("register")

    def memory(self) -> tuple[int, int] | None:
        """Available and total memory in bytes, None where the system does not say."""
        try:
            with open("/proc/meminfo", encoding="ascii") as stream:  # noqa: PTH123
                values = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in stream}
            return values["MemAvailable"], values["MemTotal"]
        except (OSError, KeyError, ValueError, IndexError):
            return None

    def display(self) -> str | None:
        """Name of the screen, None where there is none."""
        if sys.platform == "darwin":
            return "macOS"
        return os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY") or None
