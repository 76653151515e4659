"""What this machine lacks to run geomoe3d, and the exact command that mends it.

Needs nothing but Python itself: it must answer where numpy, torch or Open3D are missing or crash on
import, so every library is imported in a process of its own. The set-up script asks it for the system
packages to install (``python -m geomoe3d.doctor --apt``), so that the list stands in one place. A few
seconds, nearly all of them the imports of torch and Open3D.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from geomoe3d.runtime.machine import Machine
from geomoe3d.runtime.words import counted

State = Literal["ok", "missing", "broken"]


TORCH = "torch==2.13.0"
"""What the set-up script installs; any newer one will do."""


@dataclass(frozen=True)
class SystemLibrary:
    """A shared library that Open3D loads, and the packages that hold it."""

    soname: str
    debian: str
    fedora: str


SYSTEM_LIBRARIES = (
    SystemLibrary("libEGL.so.1", "libegl1", "libglvnd-egl"),
    SystemLibrary("libGL.so.1", "libgl1", "libglvnd-glx"),
    SystemLibrary("libX11.so.6", "libx11-6", "libX11"),
    SystemLibrary("libusb-1.0.so.0", "libusb-1.0-0", "libusb1"),
    SystemLibrary("libidn2.so.0", "libidn2-0", "libidn2"),
    SystemLibrary("libudev.so.1", "libudev1", "systemd-libs"),
    SystemLibrary("libgomp.so.1", "libgomp1", "libgomp"),
)

REQUIRED_MODULES = {
    "numpy": "numpy>=1.26",
    "scipy.spatial": "scipy>=1.12",
    "pydantic": "pydantic>=2.7",
    "yaml": "pyyaml>=6.0",
    "click": "click>=8.1.3",
    "rich": "rich>=13.7",
    "safetensors": "safetensors>=0.4.3",
    "matplotlib": "matplotlib>=3.8",
    "jinja2": "jinja2>=3.1.2",
    "trimesh": "trimesh>=4.4",
    "small_gicp": "small_gicp>=1.0.1",
    "threadpoolctl": "threadpoolctl>=3.1",
}
"""Module to import, and what to ask pip for; torch and Open3D have checks of their own."""

OPTIONAL_MODULES = {
    "lazrs": ("laspy[lazrs]>=2.5", "LAS and LAZ files"),
    "pye57": ("pye57>=0.4.11", "E57 files"),
    "cv2": ("opencv-python-headless>=4.9", "two images: relative pose and homography"),
    "simplejpeg": ("simplejpeg>=1.8", "JPEG images"),
    "h5py": ("h5py>=3.10", "cameras of YFCC100M and SUN3D"),
    "tensorboard": ("tensorboard>=2.16", "curves of a training run in TensorBoard"),
    "kiss_matcher": ("kiss-matcher>=1.0", "comparison with KISS-Matcher"),
}
"""Module to import, what to ask pip for, and what it is good for."""


@dataclass(frozen=True)
class Finding:
    """One thing looked at.

    Attributes:
        name: what was looked at.
        state: ok, missing or broken.
        detail: version, or what is wrong.
        mend: the command (or, where no command can, the step) that mends it; None when ok.
        required: whether registration needs it.
    """

    name: str
    state: State
    detail: str
    mend: str | None = None
    required: bool = True


def examine(machine: Machine | None = None) -> list[Finding]:
    """Look at everything.

    Returns:
        Findings in a fixed order, required ones first.
    """
    machine = machine or Machine()
    with ThreadPoolExecutor(max_workers=4) as pool:
        libraries = [(module, requirement, "") for module, requirement in REQUIRED_MODULES.items()]
        extras = [(module, *wanted) for module, wanted in OPTIONAL_MODULES.items()]
        torch = pool.submit(_check_torch, machine)
        open3d = pool.submit(_check_open3d, machine)
        modules = [pool.submit(_check_module, machine, *row) for row in libraries + extras]
        return [
            _check_python(machine),
            *_check_glibc(machine),
            *_check_libraries(machine),
            *(future.result() for future in modules[: len(libraries)]),
            open3d.result(),
            torch.result(),
            *(future.result() for future in modules[len(libraries) :]),
            _check_register(machine),
            _check_memory(machine),
            _check_display(machine),
        ]


def is_healthy(findings: list[Finding]) -> bool:
    """True when everything required is there and works."""
    return all(finding.state == "ok" for finding in findings if finding.required)


def missing_packages(machine: Machine | None = None) -> list[str]:
    """Debian packages that hold the shared libraries which this machine lacks."""
    machine = machine or Machine()
    if machine.system() != "linux":
        return []
    return [library.debian for library in SYSTEM_LIBRARIES if not machine.loads(library.soname)]


def mending_commands(findings: list[Finding]) -> list[str]:
    """Each different mend of a required part once, in order."""
    return list(dict.fromkeys(f.mend for f in findings if f.required and f.state != "ok" and f.mend))


def as_json(findings: list[Finding]) -> dict[str, Any]:
    """The findings as a mapping ready for JSON."""
    return {"healthy": is_healthy(findings), "findings": [asdict(finding) for finding in findings]}


def report(findings: list[Finding], paint: Callable[[str, State], str] = lambda text, state: text) -> str:
    """The findings as text: one line each, then what to do.

    Args:
        findings: what `examine` found.
        paint: gives the word of a state its colour.
    """
    width = max(len(finding.name) for finding in findings)
    lines = []
    for finding in findings:
        need = "" if finding.required or finding.state == "ok" else " (optional)"
        lines.append(
            f"{paint(f'{finding.state:8}', finding.state)}{finding.name:{width}}  {finding.detail}{need}"
        )
        if finding.mend and not finding.required:
            lines.append(f"{'':{8 + width}}  -> {finding.mend}")
    commands = mending_commands(findings)
    if commands:
        lines += ["", "Required and not there; to mend it:", *(f"  {command}" for command in commands)]
    else:
        lines += ["", "Everything required is there."]
    return "\n".join(lines)


def _pip(machine: Machine, arguments: str) -> str:
    executable = machine.executable()
    return f'"{executable}" -m pip {arguments}' if " " in executable else f"{executable} -m pip {arguments}"


def _install_system(machine: Machine, libraries: list[SystemLibrary]) -> str:
    sudo = "" if machine.is_root() else "sudo "
    if machine.family() == "fedora":
        return f"{sudo}dnf install -y " + " ".join(library.fedora for library in libraries)
    packages = " ".join(library.debian for library in libraries)
    if machine.family() == "debian":
        return f"{sudo}apt-get update && {sudo}apt-get install -y --no-install-recommends {packages}"
    return f"install with your system's package manager what Debian calls: {packages}"


def _check_python(machine: Machine) -> Finding:
    version = machine.python()
    text = ".".join(map(str, version))
    if version < (3, 10):
        mend = "PYTHON=python3.11 bash scripts/quickstart.sh"
        return Finding("python", "broken", f"{text}, but 3.10 or newer is needed", mend)
    note = " (newer than 3.13, the newest one tried)" if version >= (3, 14) else ""
    return Finding("python", "ok", f"{text}{note}, {machine.executable()}")


def _check_glibc(machine: Machine) -> list[Finding]:
    if machine.system() != "linux":
        return []
    glibc = (2, 35)  # the oldest that Open3D's wheels load on
    version, needed = machine.glibc(), ".".join(map(str, glibc))
    mend = "use Debian 12, Ubuntu 22.04, Fedora 36 or newer; the C library cannot be exchanged by itself"
    if version is None:
        problem = f"this C library is not glibc; Open3D needs glibc {needed}"
        return [Finding("glibc", "missing", problem, mend)]
    text = ".".join(map(str, version))
    if version < glibc:
        return [Finding("glibc", "broken", f"{text}, but Open3D needs {needed} or newer", mend)]
    return [Finding("glibc", "ok", text)]


def _check_libraries(machine: Machine) -> list[Finding]:
    if machine.system() != "linux":  # macOS brings them; the wheel for it needs libomp alone
        return []
    missing = [library for library in SYSTEM_LIBRARIES if not machine.loads(library.soname)]
    mend = _install_system(machine, missing) if missing else None  # one command for all of them
    return [
        Finding(library.soname, "missing", "not found; Open3D loads it", mend)
        if library in missing
        else Finding(library.soname, "ok", "found")
        for library in SYSTEM_LIBRARIES
    ]


def _check_open3d(machine: Machine) -> Finding:
    wheel = "open3d-cpu" if machine.system() == "linux" and machine.architecture() == "x86_64" else "open3d"
    versions = {name: machine.version(name) for name in ("open3d", "open3d-cpu")}
    present = {name: version for name, version in versions.items() if version is not None}
    install = _pip(machine, f"install {wheel}")
    if len(present) == 2:
        problem = "open3d and open3d-cpu are both installed and overwrite each other's files"
        mend = _pip(machine, "uninstall -y open3d open3d-cpu") + " && " + install
        return Finding("open3d", "broken", problem, mend)
    outcome = machine.run_import("import open3d; print(open3d.__version__)")
    if outcome.ok:
        name, version = next(iter(present.items()), ("built from source", outcome.text))
        return Finding("open3d", "ok", f"{version} ({name})")
    if not present:
        return Finding("open3d", "missing", "not installed", install)
    return Finding("open3d", "broken", outcome.text, _mend_open3d(machine, outcome.text, *present))


def _mend_open3d(machine: Machine, complaint: str, installed: str) -> str:
    if "cannot open shared object" in complaint or "image not found" in complaint:
        if machine.system() == "darwin":
            return "brew install libomp"
        lacking = [library for library in SYSTEM_LIBRARIES if not machine.loads(library.soname)]
        named = [library for library in SYSTEM_LIBRARIES if library.soname in complaint]
        if lacking or named:
            return _install_system(machine, lacking or named)
        match = re.search(r"[^\s:(]+\.so[.\d]*", complaint)
        library = match[0] if match else "it"
        finder = (
            f"dnf provides '*/{library}'" if machine.family() == "fedora" else f"apt-file search {library}"
        )
        return f"install the system package that holds {library}; to find its name: {finder}"
    return _pip(machine, f"install --force-reinstall {installed}")


def _check_torch(machine: Machine) -> Finding:
    if machine.version("torch") is None:
        return Finding("torch", "missing", "not installed", _pip(machine, f"install {TORCH}"))
    outcome = machine.run_import(
        "import torch; print(torch.__version__, torch.version.cuda or '-', torch.cuda.is_available(), "
        "torch.get_num_threads())"
    )
    fields = outcome.text.split()
    if not outcome.ok or len(fields) != 4:
        mend = _pip(machine, f"install --force-reinstall {TORCH}")
        return Finding("torch", "broken", outcome.text, mend)
    version, cuda, available, threads = fields
    build = "CPU build" if cuda == "-" else f"CUDA {cuda} build"
    device = "GPU usable" if available == "True" else "no GPU usable"
    return Finding("torch", "ok", f"{version}, {build}, {device}, {counted(int(threads), 'thread')}")


def _check_module(machine: Machine, module: str, requirement: str, purpose: str = "") -> Finding:
    """A library; with a purpose it is an optional one."""
    name = requirement.split(">=")[0].split("[")[0]  # as pip calls it
    note, required = (f", for {purpose}", False) if purpose else ("", True)
    outcome = machine.run_import(f"import {module}")
    if outcome.ok:
        return Finding(name, "ok", (machine.version(name) or "found") + note, required=required)
    # The requirement is quoted: a shell takes > and [ for its own.
    if f"No module named '{module.split('.')[0]}'" in outcome.text:
        mend = _pip(machine, f"install '{requirement}'")
        return Finding(name, "missing", "not installed" + note, mend, required)
    mend = _pip(machine, f"install --force-reinstall '{requirement}'")
    return Finding(name, "broken", outcome.text, mend, required)


def _check_register(machine: Machine) -> Finding:
    """Whether the short name means ours; another `register` is easily installed, by Tcl or an old package."""
    found, ours = machine.register_on_path(), Path(machine.executable()).parent
    if found is None or Path(found).parent == ours:
        return Finding("register", "ok", found or "not on the PATH; use `geomoe3d register`", required=False)
    mend = f'call `geomoe3d register` instead, or put ours first: export PATH="{ours}:$PATH"'
    return Finding("register", "broken", f"{found} comes first on the PATH", mend, required=False)


def _check_memory(machine: Machine) -> Finding:
    memory = machine.memory()
    if memory is None:
        return Finding("memory", "ok", "this system does not say", required=False)
    available, total = (amount // 2**20 for amount in memory)
    detail = f"{available:,} MiB available of {total:,} MiB"
    if available < 1024:
        mend = "close other programs, or use a larger --voxel-size"
        return Finding("memory", "broken", detail + ", little", mend, required=False)
    return Finding("memory", "ok", detail, required=False)


def _check_display(machine: Machine) -> Finding:
    display = machine.display()
    if display is not None:
        return Finding("display", "ok", display, required=False)
    problem = "no screen; only `register --show` needs one"
    mend = "use --picture or --page instead of --show, or set DISPLAY (over a network: ssh -X)"
    return Finding("display", "missing", problem, mend, required=False)


def _main(arguments: list[str]) -> int:
    if arguments == ["--apt"]:
        print(" ".join(missing_packages()))
        return 0
    if arguments:
        print(
            "usage: python -m geomoe3d.doctor [--apt]   (--apt: Debian packages to install)", file=sys.stderr
        )
        return 2
    findings = examine()
    print(report(findings))
    return 0 if is_healthy(findings) else 2


if __name__ == "__main__":  # where not even the command line's own libraries are installed
    sys.exit(_main(sys.argv[1:]))
