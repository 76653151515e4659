"""``geomoe3d train``: what is wrong is said, the configuration shown, one batch overfitted."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from training_runs import TREE, environment, write_yaml


@pytest.mark.slow
def test_train_verb_says_what_is_wrong_and_overfits(tmp_path: Path) -> None:
    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "geomoe3d.cli.main", "train", *arguments]
        return subprocess.run(
            command, env=environment(), capture_output=True, text=True, timeout=300, cwd=tmp_path
        )

    path = str(write_yaml(tmp_path / "c.yaml", TREE))
    wrong = call(path, "--set", "network.num_layer=3")
    assert wrong.returncode == 2
    assert "network.num_layers" in wrong.stderr
    assert not (tmp_path / "runs").exists()
    for old, new in (
        (["--fresh"], "--fresh is now --new"),
        (["--out", "x"], "--out is now --output"),
        (["steps=7"], "write --set steps=7"),
    ):
        refused = call(path, *old)
        assert refused.returncode == 2
        assert new in refused.stderr
    shown = call(path, "--set", "steps=7", "--show")
    assert shown.returncode == 0
    assert "steps: 7" in shown.stdout
    network = {"num_layers": 2, "width": 32, "num_sub_fields": 6, "num_heads": 2}
    network |= {"knn_space": "compatibility", "extra_channels": ["compatibility"]}
    learnt = call(path, "--overfit", "--quiet", "--set", f"network={json.dumps(network)}")
    assert learnt.returncode == 0, learnt.stderr
    assert "F1" in learnt.stdout
