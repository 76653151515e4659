"""Checkpoints: settings of another version are refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from training_runs import config_of

from geomoe3d.errors import CheckpointError
from geomoe3d.training.checkpoint import check_same_run


def test_checkpoint_with_settings_of_another_version_is_refused_by_name(tmp_path: Path) -> None:
    config = config_of()
    state = {"config": json.dumps({**config.model_dump(), "network": {"num_towers": 3}}), "data": ""}
    with pytest.raises(CheckpointError, match=r"another version.*network\.num_towers"):
        check_same_run(state, config, "", tmp_path / "last.pt")
