"""Checkpoints of a run: written whole or not at all, read without unpickling code.

``last.pt`` holds all that the next step depends on; ``best.pt`` the weights of the best validation. Each
says with which configuration, data and source revision it was made.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from geomoe3d.errors import CheckpointError, MissingWeightsError
from geomoe3d.runtime.files import write_atomically
from geomoe3d.runtime.provenance import differences, in_words, source_commit
from geomoe3d.training.config import FREE_KEYS, TrainConfig

_FORMAT = "geomoe3d-checkpoint"
_VERSION = 1


def save_checkpoint(path: Path, state: dict[str, Any], config: TrainConfig, data: str) -> None:
    """Replace ``path`` by ``state`` plus what identifies it; on disk before this returns."""
    complete = {
        "format": _FORMAT,
        "version": _VERSION,
        "config": config.model_dump_json(),
        "data": data,
        "commit": source_commit(),
        **state,
    }

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            torch.save(complete, file)
            file.flush()
            os.fsync(file.fileno())

    write_atomically(path, write, force=True)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The state of ``path``, tensors on the CPU. Raises CheckpointError: unreadable, truncated, or not one of
    ours."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise MissingWeightsError(f"no checkpoint '{path}'") from None
    except Exception as error:  # torch names no common class for what a damaged file raises
        raise CheckpointError(f"checkpoint '{path}' cannot be read: {error}") from None
    if not isinstance(state, dict) or state.get("format") != _FORMAT or state.get("version") != _VERSION:
        raise CheckpointError(f"'{path}' is no checkpoint of this version of geomoe3d")
    return state


def check_same_run(state: dict[str, Any], config: TrainConfig, data: str, path: Path) -> None:
    """Refuse to go on with another configuration or other data than the run began with. Raises
    CheckpointError: names what differs."""
    try:
        before = TrainConfig.model_validate_json(state["config"])
    except ValidationError as error:
        keys = ", ".join(".".join(map(str, e["loc"])) for e in error.errors())
        raise CheckpointError(
            f"'{path}' was made by another version of geomoe3d, whose settings this one does not know "
            f"({keys}); train into another folder"
        ) from None
    differing = differences(before.model_dump(mode="json"), config.model_dump(mode="json"))
    changed = {
        key: values
        for key, values in differing.items()
        if not any(f"{key}.".startswith(f"{free}.") for free in FREE_KEYS)
    }
    if changed:
        raise CheckpointError(
            f"'{path}' was made with other settings; set them back, or train into another folder (start from these "
            f"weights with init_from). They differ in {in_words(changed)}"
        )
    if state["data"] != data:
        raise CheckpointError(f"'{path}' was trained on other data: {state['data']}, now {data}")
