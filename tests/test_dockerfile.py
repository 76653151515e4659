"""The Dockerfile names what there is, runs as nobody, and its Python commands are those of this checkout."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "Dockerfile").read_text()


def test_the_dockerfile_copies_what_the_package_is_built_from() -> None:
    copied = [word for line in re.findall(r"^COPY (.*)$", TEXT, re.MULTILINE) for word in line.split()[:-1]]
    assert all((ROOT / name).exists() for name in copied)
    project = (ROOT / "pyproject.toml").read_text()
    assert {"geomoe3d", "configs", "README.md", "LICENSE"} <= set(copied)  # what the wheel is made of
    for extra in re.search(r'"\.\[([\w,]+)\]"', TEXT)[1].split(","):
        assert re.search(rf"^{extra} = \[", project, re.MULTILINE), extra


def test_the_container_runs_as_nobody_and_needs_no_more() -> None:
    last = TEXT[TEXT.rindex("RUN ") :]
    user = re.search(r"^USER (\d+):(\d+)$", last, re.MULTILINE)
    assert user is not None and int(user[1]) and int(user[2])
    assert 'ENTRYPOINT ["geomoe3d"]' in last
    version = re.search(r"^FROM python:(\d+\.\d+)-slim$", TEXT, re.MULTILINE)
    assert version is not None and f"Python :: {version[1]}" in (ROOT / "pyproject.toml").read_text()
    assert len(re.findall(r"^torch==", (ROOT / "constraints.txt").read_text(), re.MULTILINE)) == 1
