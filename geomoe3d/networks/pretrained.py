"""Networks to and from weights on disk, with torch; see `geomoe3d.networks.weight_files`."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import torch

from geomoe3d.errors import CheckpointError
from geomoe3d.networks.build import Network, build_network
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.weight_files import (
    CARD_FORMAT,
    CARD_VERSION,
    WeightCard,
    card_path,
    find_weights,
    read_weights,
)
from geomoe3d.runtime.files import check_output, write_atomically, write_text


def save_pretrained(
    path: str | Path, model: Network, card: WeightCard, *, force: bool = False, half: bool = False
) -> WeightCard:
    """Write ``path`` (.safetensors) and its card (.json beside it).

    Args:
        path: ending in .safetensors.
        model: whose parameters and buffers are written.
        card: architecture and hash are filled in here.
        force: replace existing files.
        half: in half precision, for shipping; else as float32.

    Returns:
        The card as written.

    Raises:
        OutputError: a file exists and ``force`` is False, or it cannot be written.
        CheckpointError: another suffix, or numbers beyond the range of half precision.
    """
    from safetensors.torch import save

    path = Path(path)
    if path.suffix != ".safetensors":
        raise CheckpointError(f"weights are written as .safetensors, not '{path.name}'")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    if half:
        tensors = {name: t.half() if t.is_floating_point() else t for name, t in tensors.items()}
        lost = [name for name, t in tensors.items() if not bool(t.isfinite().all())]
        if lost:
            raise CheckpointError(f"'{lost[0]}' does not fit half precision; save in single precision")
    data = save(tensors)
    for file in (path, card_path(path)):  # both or neither
        check_output(file, force=force)
    write_atomically(path, lambda temporary: _write(temporary, data), force=force)
    values = asdict(card)
    values["architecture"] = model.config.model_dump(mode="json")
    values["sha256"] = hashlib.sha256(data).hexdigest()
    text = json.dumps({"format": CARD_FORMAT, "version": CARD_VERSION, **values}, indent=2) + "\n"
    write_text(card_path(path), text, force=force)
    return WeightCard(**values)


def load_pretrained(name_or_path: str | Path) -> tuple[GeoMoE, WeightCard]:
    """A GeoMoE in evaluation mode, and its card; see `load_network`. Raises CheckpointError: as there, and
    for weights of another architecture."""
    model, card = load_network(name_or_path)
    if not isinstance(model, GeoMoE):
        kind = model.config.kind
        raise CheckpointError(f"'{name_or_path}' holds weights of '{kind}', not of 'geomoe': give that name")
    return model, card


def load_network(name_or_path: str | Path) -> tuple[Network, WeightCard]:
    """Any network in evaluation mode, on the CPU, and its card.

    Args:
        name_or_path: a .safetensors file with its card beside it, or the name of weights that ship with
            the package (see `geomoe3d.networks.weight_files`).

    Raises:
        CheckpointError: not found, card missing or malformed, hash differs, or tensors do not fit.
    """
    config, arrays, card = read_weights(name_or_path)
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    model = build_network(config)
    expected = model.state_dict()
    missing, extra = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    shaped = [n for n in expected.keys() & tensors.keys() if expected[n].shape != tensors[n].shape]
    if missing or extra or shaped:
        first = (missing + extra + sorted(shaped))[0]
        raise CheckpointError(
            f"'{find_weights(name_or_path)}' does not fit its architecture: {len(missing)} tensors missing, "
            f"{len(extra)} unknown, {len(shaped)} of another shape, e.g. '{first}'"
        )
    model.load_state_dict(tensors)
    return model.eval(), card


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)
