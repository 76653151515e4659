"""JSON and YAML nested beyond what their parsers can follow: damaged files, and no fault of the program."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from command_line import ROOT

from geomoe3d.batch.folder import read_identity
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.transform_files import load_transform
from geomoe3d.config import load_config, set_keys
from geomoe3d.data.shards import read_meta
from geomoe3d.errors import CheckpointError, ConfigError, FormatError, InputError
from geomoe3d.evaluation.predictions import read_info
from geomoe3d.images.scenes import read_scene
from geomoe3d.multiway.initial import read_poses
from geomoe3d.networks.weight_files import read_card
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.journal import read_journal
from geomoe3d.runtime.plain import parse_json

DEEP = 200_000
NESTED = {"lists": "[" * DEEP + "]" * DEEP, "objects": '{"frames":' * DEEP + "1" + "}" * DEEP}
READERS = {
    "a.gltf": (load_points, FormatError),
    "transforms.json": (lambda path: read_scene(path.parent), FormatError),
    "T.json": (load_transform, FormatError),
    "T.txt": (load_transform, FormatError),
    "poses.json": (lambda path: read_poses(path, ["a", "b"]), FormatError),
    "result.json": (lambda path: RegistrationResult.from_json(path.read_text()), InputError),
    "weights.json": (lambda path: read_card(path.with_suffix(".safetensors")), CheckpointError),
    "run.json": (lambda path: read_info(path.parent), FormatError),
    "shard.json": (lambda path: read_meta(path.parent), FormatError),
    "lines.jsonl": (lambda path: list(read_journal(path)), FormatError),
    "config.yaml": (lambda path: load_config(path), ConfigError),
    "set": (lambda path: set_keys({}, [f"seed={path.read_text()}"]), ConfigError),
}


@pytest.mark.parametrize("nested", NESTED)
@pytest.mark.parametrize("name", READERS)
def test_it_is_a_plain_error(name: str, nested: str, tmp_path: Path) -> None:
    read, kind = READERS[name]
    (tmp_path / name).write_text(NESTED[nested] + "\n")
    with pytest.raises(kind, match=r"nested too deeply|no JSON object"):
        read(tmp_path / name)


def test_a_batch_says_so_too(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(NESTED["lists"])
    with pytest.raises(FormatError, match="nested too deeply"):
        read_identity(tmp_path)


def test_json_is_read_as_ever_and_too_many_digits_are_said() -> None:
    value = {"a": [1, 2.5, None, "x"], "b": {"c": True}}
    assert parse_json(json.dumps(value)) == value
    assert parse_json(b"[7]", parse_int=float) == [7.0]
    with pytest.raises(json.JSONDecodeError):
        parse_json("{")
    with pytest.raises(ValueError, match="a number in it has too many digits"):
        parse_json("9" * 10_000)


def test_every_reader_of_json_and_yaml_asks_in_one_place() -> None:
    found = subprocess.run(
        ["grep", "-rnE", r"json\.loads?\(|yaml\.(safe_)?load\(", "geomoe3d", "--include=*.py"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.splitlines()  # fmt: skip
    own = ("to_json(", "settings.config")  # what this package has just written
    assert {line.split(":")[0] for line in found if not any(word in line for word in own)} == {
        "geomoe3d/runtime/plain.py",
        "geomoe3d/config/reading.py",
    }
