"""Weights on disk: a safetensors file and, beside it, a JSON card that says what it is.

The card names the architecture, what the network was trained on and how well it did, and holds the hash of
the weights. Nothing is unpickled; a file whose hash, architecture or tensors do not fit is refused.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from geomoe3d.config import build_config
from geomoe3d.errors import CheckpointError, ConfigError, MissingWeightsError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.build import Network, build_network
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.weight_files import check_weights, find_weights
from geomoe3d.runtime.files import check_output, write_atomically, write_text

_FORMAT = "geomoe3d-weights"
_VERSION = 1


@dataclass(frozen=True)
class WeightCard:
    """What a weight file is.

    Attributes:
        architecture: the network's configuration as nested mapping.
        voxel_size: (least, most) voxel size seen in training, metres; coordinates are divided by it, so
            others work as far as the scenes look alike in voxels.
        training_data: identity of the data set.
        steps: updates of the weights.
        metrics: on the validation set of the run, e.g. registration_recall.
        commit: source revision that trained it.
        sha256: of the safetensors file.
        notes: anything else worth knowing.
    """

    architecture: dict[str, Any]
    voxel_size: tuple[float, float] | None = None
    training_data: str = ""
    steps: int = 0
    metrics: dict[str, float] = field(default_factory=dict)
    commit: str = ""
    sha256: str = ""
    notes: str = ""


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
    text = json.dumps({"format": _FORMAT, "version": _VERSION, **values}, indent=2) + "\n"
    write_text(card_path(path), text, force=force)
    return WeightCard(**values)


def load_pretrained(name_or_path: str | Path) -> tuple[GeoMoE, WeightCard]:
    """A GeoMoE in evaluation mode, and its card; see `load_network`.

    Raises:
        CheckpointError: as there, and for weights of another architecture.
    """
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
    from safetensors import SafetensorError
    from safetensors.torch import load

    card = read_card(find_weights(name_or_path))
    path = check_weights(name_or_path)
    data = path.read_bytes()
    try:
        config = build_config(NetworkConfig, card.architecture, f"architecture in '{card_path(path)}'")
        tensors = load(data)
    except (ConfigError, SafetensorError) as error:
        raise CheckpointError(f"'{path}': {error}") from None
    model = build_network(config)
    expected = model.state_dict()
    missing, extra = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    shaped = [n for n in expected.keys() & tensors.keys() if expected[n].shape != tensors[n].shape]
    if missing or extra or shaped:
        first = (missing + extra + sorted(shaped))[0]
        raise CheckpointError(
            f"'{path}' does not fit its architecture: {len(missing)} tensors missing, {len(extra)} unknown, "
            f"{len(shaped)} of another shape, e.g. '{first}'"
        )
    model.load_state_dict(tensors)
    return model.eval(), card


def read_card(path: str | Path) -> WeightCard:
    """The card beside a weight file.

    Raises:
        CheckpointError: missing, unreadable, or of another format or version.
    """
    place = card_path(Path(path))
    try:
        values = json.loads(place.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MissingWeightsError(
            f"'{path}' has no card: '{place}' is missing; keep both files together"
        ) from None
    except (OSError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CheckpointError(f"card '{place}' cannot be read: {error}") from None
    if not isinstance(values, dict) or values.pop("format", None) != _FORMAT:
        raise CheckpointError(f"'{place}' is no card of geomoe3d weights")
    if (version := values.pop("version", None)) != _VERSION:
        raise CheckpointError(f"card '{place}' has version {version}; this geomoe3d reads {_VERSION}")
    try:
        card = WeightCard(**values)
    except TypeError as error:
        raise CheckpointError(f"card '{place}': {error}") from None
    if not isinstance(card.architecture, dict) or not isinstance(card.sha256, str):
        raise CheckpointError(f"card '{place}' lacks a proper architecture or hash")
    return card


def card_path(path: Path) -> Path:
    """Where the card of a weight file stands."""
    return path.with_suffix(".json")


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)
