"""The set-up script's decisions, with programs in its path that only write down how they were called."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "environment.sh"

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")


class Shell:
    """A shell whose path holds only what the test puts there, and a few harmless tools."""

    def __init__(self, folder):
        self.log = folder / "log"
        self.bin = folder / "bin"
        self.bin.mkdir()
        for tool in ("bash", "dirname", "cat", "sed", "env", "grep", "cksum"):
            (self.bin / tool).symlink_to(shutil.which(tool))

    def program(self, name, body=""):
        """A program that appends its name and arguments to the log and then does ``body``."""
        path = self.bin / name
        path.write_text(f'#!{shutil.which("bash")}\necho "{name} $*" >>"{self.log}"\n{body}\n')
        path.chmod(0o755)

    def run(self, code, **environment):
        done = subprocess.run(
            [shutil.which("bash"), "-c", f'set -euo pipefail; source "{SCRIPT}"; {code}'],
            env={"PATH": str(self.bin), **environment},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        calls = self.log.read_text().splitlines() if self.log.exists() else []
        return done.returncode, done.stdout + done.stderr, calls


@pytest.fixture
def shell(tmp_path):
    return Shell(tmp_path)


def user(shell, number):
    shell.program("id", f"echo {number}")


def test_nothing_to_install_calls_nothing(shell):
    assert shell.run("install_packages") == (0, "", [])


def test_packages_are_named_and_installed_by_root(shell):
    user(shell, 0)
    shell.program("apt-get")
    code, said, calls = shell.run("install_packages libegl1 libgl1")
    assert code == 0
    assert "system packages: libegl1 libgl1" in said
    assert calls[1:] == [
        "apt-get update -qq",
        "apt-get install -y -qq --no-install-recommends libegl1 libgl1",
    ]


def test_others_use_sudo(shell):
    user(shell, 1000)
    shell.program("apt-get")
    shell.program("sudo", 'exec "$@"')
    code, _, calls = shell.run("install_packages libgl1")
    assert code == 0
    assert "sudo apt-get update -qq" in calls
    assert "apt-get install -y -qq --no-install-recommends libgl1" in calls


def test_without_sudo_or_apt_the_script_says_what_is_needed(shell):
    code, said, _ = shell.run("install_packages libgl1 libegl1")
    assert code == 1 and "no apt-get" in said and "libgl1 libegl1" in said
    user(shell, 1000)
    shell.program("apt-get")
    code, said, calls = shell.run("install_packages libgl1")
    assert code == 1 and "apt-get install libgl1" in said
    assert not any(call.startswith("apt-get") for call in calls)


def test_an_interpreter_that_will_not_do_is_refused(shell):
    code, said, _ = shell.run("choose_python", PYTHON="python9.9")
    assert code == 1 and "python9.9" in said
    shell.program("python2", "exit 1")
    code, said, _ = shell.run("choose_python", PYTHON="python2")
    assert code == 1 and "3.10" in said


def test_the_first_interpreter_that_will_do_is_taken(shell):
    shell.program("python3", "exit 1")  # too old
    (shell.bin / "python3.11").symlink_to(sys.executable)
    code, said, _ = shell.run('choose_python; echo "took $base"')
    assert code == 0 and said == f"took {shell.bin / 'python3.11'}\n"


def torch_calls(shell, pip, **environment):
    """What pip is asked for where torch is not installed; ``pip`` is what becomes of it."""
    shell.program("fake-python", f'case "$*" in *importlib*) exit 1;; *) {pip};; esac')
    code, said, calls = shell.run("python=fake-python; install_torch", **environment)
    return code, said, [call.split("constraints.txt ")[1] for call in calls if " pip install " in call]


def test_torch_without_a_gpu_is_the_cpu_build_where_there_is_one(shell):
    code, said, asked = torch_calls(shell, "echo Successfully installed torch-2.13.0+cpu")
    assert (code, asked) == (0, ["torch==2.13.0+cpu"])
    assert "installed: torch-2.13.0+cpu" in said


def test_torch_falls_back_where_the_index_holds_no_cpu_build(shell):
    code, _, asked = torch_calls(shell, 'case "$*" in *+cpu) exit 1;; esac')
    assert (code, asked) == (0, ["torch==2.13.0+cpu", "torch==2.13.0"])


def test_torch_that_cannot_be_installed_stops_the_script(shell):
    assert torch_calls(shell, "exit 1")[0] != 0


def test_torch_from_the_index_that_the_user_names(shell):
    code, _, asked = torch_calls(shell, "exit 0", GEOMOE3D_TORCH_INDEX="file:///wheels")
    assert (code, asked) == (0, ["--index-url file:///wheels torch==2.13.0"])


def test_torch_for_a_gpu(shell):
    shell.program("nvidia-smi")
    assert torch_calls(shell, "exit 0")[::2] == (0, ["torch==2.13.0"])


def test_torch_that_is_there_is_left_alone(shell):
    shell.program("fake-python")
    code, said, calls = shell.run("python=fake-python; install_torch")
    assert (code, said, len(calls)) == (0, "", 1)


def test_the_package_is_installed_again_only_after_its_metadata_changed(shell, tmp_path):
    checkout = tmp_path / "my checkout"
    (checkout / ".venv").mkdir(parents=True)
    for name in ("pyproject.toml", "constraints.txt"):
        (checkout / name).write_text("one")
    shell.program("fake-python")
    code = f'python=fake-python; checkout="{checkout}"; venv="$checkout/.venv"; install_package dev,las'
    for name, text, count in (
        ("pyproject.toml", "one", 1),
        ("pyproject.toml", "two", 2),
        ("pyproject.toml", "two", 2),
        ("constraints.txt", "two", 3),
    ):
        (checkout / name).write_text(text)
        assert shell.run(code)[0] == 0
        calls = [call for call in shell.log.read_text().splitlines() if "--editable .[dev,las]" in call]
        assert len(calls) == count
    (checkout / "pyproject.toml").unlink()
    assert shell.run(code)[0] != 0
