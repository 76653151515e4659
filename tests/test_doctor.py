"""The doctor on machines that lack something, and on this one."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from geomoe3d import doctor
from geomoe3d.cli.errors import run
from geomoe3d.cli.main import geomoe3d
from geomoe3d.runtime.machine import ImportOutcome, Machine

ROOT = Path(__file__).parents[1]


class Patient(Machine):
    """A healthy Debian machine without a GPU, on which single answers can be changed."""

    def __init__(self, lacking=(), not_installed=("open3d",), complaints=None, **answers):
        self.lacking, self.not_installed, self.complaints = lacking, not_installed, complaints or {}
        healthy = {
            "system": "linux",
            "architecture": "x86_64",
            "family": "debian",
            "python": (3, 11, 2),
            "executable": "/venv/bin/python",
            "glibc": (2, 36),
            "is_root": False,
            "register_on_path": "/venv/bin/register",
            "memory": (8 * 2**30, 16 * 2**30),
            "display": ":0",
        }
        for question, answer in {**healthy, **answers}.items():
            assert hasattr(Machine, question)
            setattr(self, question, lambda answer=answer: answer)

    def loads(self, soname):
        return soname not in self.lacking

    def version(self, distribution):
        return None if distribution in self.not_installed else "1.2.3"

    def run_import(self, code):
        module = re.search(r"import (\w+)", code)[1]
        if module in self.complaints:
            return ImportOutcome(False, self.complaints[module])
        if module in self.not_installed and module != "open3d":
            return ImportOutcome(False, f"ModuleNotFoundError: No module named '{module}'")
        return ImportOutcome(True, "2.13.0+cpu - False 2" if module == "torch" else "1.2.3")


def findings_of(**answers):
    findings = doctor.examine(Patient(**answers))
    assert len({finding.name for finding in findings}) == len(findings)
    for finding in findings:  # a finding is either fine or says what to do
        assert (finding.state == "ok") == (finding.mend is None)
    return {finding.name: finding for finding in findings}


def sick(findings):
    return {name for name, finding in findings.items() if finding.state != "ok"}


def test_a_healthy_machine():
    findings = findings_of()
    assert not sick(findings)
    assert doctor.is_healthy(list(findings.values()))
    assert findings["torch"].detail == "2.13.0+cpu, CPU build, no GPU usable, 2 threads"
    assert "Everything required is there." in doctor.report(list(findings.values()))


def test_missing_libraries_are_mended_by_one_command_that_names_them_all():
    lacking = ("libusb-1.0.so.0", "libEGL.so.1")
    findings = findings_of(
        lacking=lacking,
        complaints={"open3d": "OSError: libusb-1.0.so.0: cannot open shared object file: No such file"},
    )
    assert sick(findings) == {*lacking, "open3d"}
    assert not doctor.is_healthy(list(findings.values()))
    command = "sudo apt-get update && sudo apt-get install -y --no-install-recommends libegl1 libusb-1.0-0"
    assert doctor.mending_commands(list(findings.values())) == [command]
    assert f"  {command}" in doctor.report(list(findings.values())).splitlines()


def test_another_program_called_register_is_named():
    finding = findings_of(register_on_path="/usr/bin/register")["register"]
    assert finding.state == "broken" and not finding.required
    assert "/usr/bin/register comes first" in finding.detail
    assert "geomoe3d register" in finding.mend and 'export PATH="/venv/bin:$PATH"' in finding.mend
    assert findings_of(register_on_path=None)["register"].state == "ok"


def test_root_needs_no_sudo_and_fedora_no_apt():
    usb = {"lacking": ("libusb-1.0.so.0",)}
    assert findings_of(is_root=True, **usb)["libusb-1.0.so.0"].mend == (
        "apt-get update && apt-get install -y --no-install-recommends libusb-1.0-0"
    )
    assert findings_of(family="fedora", **usb)["libusb-1.0.so.0"].mend == "sudo dnf install -y libusb1"
    unknown = findings_of(family="", **usb)["libusb-1.0.so.0"].mend
    assert "libusb-1.0-0" in unknown and "apt-get" not in unknown


def test_an_unknown_library_is_named_as_the_loader_names_it():
    complaint = "ImportError: libfoo.so.3: cannot open shared object file: No such file or directory"
    finding = findings_of(complaints={"open3d": complaint})["open3d"]
    assert finding.state == "broken"
    assert "apt-file search libfoo.so.3" in finding.mend
    fedora = findings_of(complaints={"open3d": complaint}, family="fedora")["open3d"]
    assert "dnf provides '*/libfoo.so.3'" in fedora.mend


def test_a_mac_has_no_glibc_and_no_apt():
    findings = findings_of(
        system="darwin",
        not_installed=("open3d-cpu",),
        complaints={"open3d": "ImportError: dlopen: Library not loaded: libomp.dylib (image not found)"},
    )
    assert "glibc" not in findings and not any(name.startswith("lib") for name in findings)
    assert findings["open3d"].mend == "brew install libomp"


@pytest.mark.parametrize("version", [(2, 31), (2, 9), None])
def test_an_old_or_foreign_c_library(version):
    finding = findings_of(glibc=version)["glibc"]
    assert finding.state != "ok" and finding.required
    assert "2.35" in finding.detail
    assert "Debian 12" in finding.mend


@pytest.mark.parametrize("version", [(2, 35), (2, 41), (3, 0)])
def test_a_c_library_that_will_do(version):
    assert findings_of(glibc=version)["glibc"].state == "ok"


def test_no_torch():
    findings = findings_of(not_installed=("open3d", "torch"))
    assert sick(findings) == {"torch"}
    assert findings["torch"].mend == f"/venv/bin/python -m pip install {doctor.TORCH}"
    quoted = findings_of(not_installed=("open3d", "torch"), executable="/my venv/bin/python")["torch"].mend
    assert quoted.startswith('"/my venv/bin/python" -m pip')


def test_torch_with_and_without_a_gpu_and_broken():
    class WithGpu(Patient):
        def run_import(self, code):
            if "torch" in code:
                return ImportOutcome(True, "2.13.0 13.0 True 16")
            return super().run_import(code)

    findings = {finding.name: finding for finding in doctor.examine(WithGpu())}
    assert findings["torch"].detail == "2.13.0, CUDA 13.0 build, GPU usable, 16 threads"
    broken = findings_of(complaints={"torch": "the process died of signal 4 during import"})["torch"]
    assert broken.state == "broken" and "signal 4" in broken.detail and "--force-reinstall" in broken.mend


def test_open3d_absent_and_installed_twice():
    complaint = {"open3d": "ModuleNotFoundError: No module named 'open3d'"}
    absent = findings_of(not_installed=("open3d", "open3d-cpu"), complaints=complaint)["open3d"]
    assert absent.state == "missing" and absent.mend == "/venv/bin/python -m pip install open3d-cpu"
    arm = findings_of(not_installed=("open3d", "open3d-cpu"), complaints=complaint, architecture="aarch64")[
        "open3d"
    ]
    assert arm.mend == "/venv/bin/python -m pip install open3d"
    twice = findings_of(not_installed=())["open3d"]
    assert twice.state == "broken" and "both" in twice.detail
    assert twice.mend == (
        "/venv/bin/python -m pip uninstall -y open3d open3d-cpu && /venv/bin/python -m pip install open3d-cpu"
    )


def test_extras_memory_and_display_are_no_reason_to_fail():
    findings = findings_of(
        not_installed=("open3d", "lazrs", "pye57"), memory=(500 * 2**20, 2**31), display=None
    )
    assert sick(findings) == {"laspy", "pye57", "memory", "display"}
    assert doctor.is_healthy(list(findings.values()))
    assert findings["laspy"].mend == "/venv/bin/python -m pip install 'laspy[lazrs]>=2.5'"
    assert "500 MiB" in findings["memory"].detail


def test_old_python():
    finding = findings_of(python=(3, 9, 18))["python"]
    assert finding.state == "broken" and "3.10" in finding.detail
    assert findings_of(python=(3, 14, 0))["python"].state == "ok"


def test_requirements_are_those_of_the_package():
    text = (ROOT / "pyproject.toml").read_text()
    wanted = {*doctor.REQUIRED_MODULES.values(), *(need for need, _ in doctor.OPTIONAL_MODULES.values())}
    for requirement in wanted:
        assert re.search(f'"{re.escape(requirement)}["; ]', text), requirement
    declared = set(re.findall(r'^  "([\w.-]+)', text.split("dependencies = [")[1].split("]\n")[0], re.M))
    known = {re.split(r"[>\[]", need)[0] for need in doctor.REQUIRED_MODULES.values()}
    assert declared - known == {"open3d-cpu", "open3d", "torch"}  # these have checks of their own


def test_this_machine_can_run_the_tests():
    findings = doctor.examine()
    assert doctor.is_healthy(findings), doctor.report(findings)
    assert doctor.missing_packages() == []


def test_libraries_and_packages_that_nobody_has():
    machine = Machine()
    assert not machine.loads("libthere-is-none.so.1")
    assert machine.version("there-is-no-such-distribution") is None
    assert machine.run_import("import there_is_none") == ImportOutcome(
        False, "ModuleNotFoundError: No module named 'there_is_none'"
    )
    assert machine.run_import("import os; os.abort()").text == "the process died of signal 6 during import"


def test_verb_prints_json_and_ends_with_the_verdict(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "Machine", lambda: Patient(lacking=("libGL.so.1",)))
    assert run(geomoe3d, "geomoe3d", ["doctor", "--json"]) == 2
    answer = json.loads(capsys.readouterr().out)
    assert answer["healthy"] is False
    assert [f["name"] for f in answer["findings"] if f["state"] != "ok"] == ["libGL.so.1"]
    assert run(geomoe3d, "geomoe3d", ["doctor"]) == 2
    assert "libgl1" in capsys.readouterr().out
    monkeypatch.setattr(doctor, "Machine", Patient)
    assert run(geomoe3d, "geomoe3d", ["doctor"]) == 0


@pytest.fixture
def bare(tmp_path):
    """The package without any library beside it, run by a Python that sees no installed packages."""
    shutil.copytree(ROOT / "geomoe3d", tmp_path / "geomoe3d", ignore=shutil.ignore_patterns("__pycache__"))
    return lambda *arguments: subprocess.run(
        [sys.executable, "-S", "-m", "geomoe3d.doctor", *arguments],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_runs_where_nothing_is_installed_at_all(bare):
    """-S leaves out site-packages, so that not even numpy and click are there."""
    done = bare("--apt")
    assert (done.returncode, done.stdout, done.stderr) == (0, "\n", "")
    assert bare("--what").returncode == 2
