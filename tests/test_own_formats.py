"""Readers and writers of a user's own: the example by the command line, in workers, and misuse."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cloud_files import small_cloud

from geomoe3d.batch.task import Settings
from geomoe3d.clouds.formats import registry
from geomoe3d.clouds.io import load_points, save_points, use_part
from geomoe3d.clouds.loading import read_raw
from geomoe3d.config import RegistrationConfig
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.errors import ConfigError, FormatError

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "reader.py"


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is taken here is given back."""
    for table in (registry.READERS, registry.CLOUD_WRITERS, registry.MESH_WRITERS):
        for suffix in table:
            monkeypatch.setitem(table, suffix, table[suffix])
    monkeypatch.setattr(registry, "_taken", set())
    for variable in registry.VARIABLES.values():
        monkeypatch.setenv(variable, "")
    before = [dict(table) for table in (registry.READERS, registry.CLOUD_WRITERS)]
    yield
    for table, held in zip((registry.READERS, registry.CLOUD_WRITERS), before, strict=True):
        table.clear()
        table.update(held)


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", "geomoe3d", *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )


def test_the_example_reads_and_writes_for_the_command_line(tmp_path: Path) -> None:
    assert len(EXAMPLE.read_text().splitlines()) <= 60
    source, target, T = make_sample_pair()
    for name, cloud in (("source", source), ("target", target)):
        rows = (json.dumps({"p": p, "t": k}) for k, p in enumerate(cloud.file_points[::4].tolist()))
        (tmp_path / f"{name}.jsonl").write_text("\n".join(rows) + "\n")
    (tmp_path / "mine.py").write_text(EXAMPLE.read_text())
    own = ["--reader", "mine.py:read_lines"]
    words = ["--writer", "mine.py:LineWriter", "--aligned", "moved.jsonl", "--json"]
    done = run(tmp_path, "register", "source.jsonl", "target.jsonl", *own, *words)
    assert done.returncode == 0, done.stderr
    found = np.array(json.loads(done.stdout)["T_target_source"])
    assert np.abs(found - T).max() < 0.05
    moved = [json.loads(line) for line in (tmp_path / "moved.jsonl").read_text().splitlines()]
    assert [row["t"] for row in moved] == list(range(len(moved)))
    expected = source.file_points[::4] @ found[:3, :3].T + found[:3, 3]
    np.testing.assert_allclose([row["p"] for row in moved], expected, atol=1e-9)
    (tmp_path / "pairs.csv").write_text("source,target\nsource.jsonl,target.jsonl\n")
    batch = ["batch", "pairs.csv", "out", "--workers", "1", "--no-cache"]
    assert run(tmp_path, *batch, *own).returncode == 0
    done = run(tmp_path, *batch)  # another reader, another batch
    assert done.returncode == 2 and "They differ in readers..jsonl" in done.stderr, done.stderr
    (tmp_path / "mine.py").write_text(EXAMPLE.read_text() + "# other code\n")
    done = run(tmp_path, *batch, *own)
    assert done.returncode == 2 and "readers..jsonl.code" in done.stderr, done.stderr
    done = run(tmp_path, "register", "source.jsonl", "target.jsonl", "--reader", "mine.py:read_line")
    assert done.returncode == 2 and "did you mean 'read_lines'" in done.stderr


@pytest.mark.usefixtures("alone")
def test_in_python_and_in_place_of_ours(tmp_path: Path) -> None:
    use_part("reader", f"{EXAMPLE}:read_lines")
    (tmp_path / "a.jsonl").write_text('{"p": [1, 2, 3], "ring": 7}\n')
    assert read_raw(tmp_path / "a.jsonl").fields["ring"] == [7]
    assert Settings.of(RegistrationConfig(), "").readers == (f"{EXAMPLE}:read_lines",)  # also on a cluster
    (tmp_path / "a.jsonl").write_text('{"p": [1, 2]\n')
    with pytest.raises(FormatError, match="line 1 is no point"):
        load_points(tmp_path / "a.jsonl")
    use_part("writer", f"{EXAMPLE}:LineWriter")
    save_points(tmp_path / "b.jsonl", small_cloud())
    np.testing.assert_array_equal(load_points(tmp_path / "b.jsonl").file_points, small_cloud())
    (tmp_path / "mine.py").write_text(
        "import numpy as np\nfrom geomoe3d.clouds.formats.registry import reader\n"
        "@reader('.xyz')\nclass Mine:\n    def __call__(self, path):\n        return np.full((4, 3), 7.0)\n"
        "def bare(path):\n    return None\n"
    )
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    use_part("reader", f"{tmp_path / 'mine.py'}:Mine")
    assert np.array_equal(load_points(tmp_path / "a.xyz").file_points, np.full((4, 3), 7.0))
    for kind, name, word in (
        ("reader", "bare", "decorate it with reader"),
        ("writer", "Mine", "decorate it with writer"),
        ("reader", "none", "holds no 'none'"),
    ):
        with pytest.raises(ConfigError, match=word):
            use_part(kind, f"{tmp_path / 'mine.py'}:{name}")
