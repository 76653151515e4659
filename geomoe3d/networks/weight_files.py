"""Where weight files lie, their cards and their tensors; needs no torch.

Weights are a safetensors file and, beside it, a JSON card that says what it is: the architecture, what the
network was trained on and how well it did, and the hash of the weights. Nothing is unpickled; a file whose
hash, architecture or tensors do not fit is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from geomoe3d.config import build_config
from geomoe3d.errors import CheckpointError, ConfigError, MissingWeightsError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.runtime.files import file_hash
from geomoe3d.runtime.plain import parse_json

PACKAGED = Path(__file__).parent / "weights"
DEFAULT_WEIGHTS = "geomoe3d"
"""Name of the weights that ship with the package."""

CARD_FORMAT, CARD_VERSION = "geomoe3d-weights", 1


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


def find_weights(name_or_path: str | Path) -> Path:
    """The file that a name or path means. Raises CheckpointError: there is none; the message lists what ships
    with the package."""
    path = Path(name_or_path)
    if path.is_file():
        return path
    packaged = PACKAGED / f"{name_or_path}.safetensors"
    if path.suffix != ".safetensors" and path.name == str(name_or_path) and packaged.is_file():
        return packaged
    names = ", ".join(packaged_names()) or "none in this version"
    raise MissingWeightsError(f"no weights '{name_or_path}': no such file, and packaged weights are: {names}")


def packaged_names() -> list[str]:
    """Names of the weights that ship with the package."""
    return sorted(path.stem for path in PACKAGED.glob("*.safetensors"))


def judges_transforms(name_or_path: str | Path) -> bool:
    """Whether weights are of a network that scores transforms, by their card; False where there is no card.
    Raises CheckpointError: no such weights."""
    card = find_weights(name_or_path).with_suffix(".json")
    try:
        architecture = parse_json(card.read_text(encoding="utf-8"))["architecture"]
        return "aligned" in architecture.get("extra_channels", ())
    except (OSError, ValueError, KeyError, AttributeError, TypeError):
        return False  # loading the weights says what is wrong with the card


def check_weights(name_or_path: str | Path) -> Path:
    """The file that a name or path means, whose content is what its card says; needs no torch. Raises
    CheckpointError: not found, without a proper card, or damaged."""
    path = find_weights(name_or_path)
    expected = read_card(path).sha256
    if (digest := file_hash(path, CheckpointError)) != expected:
        raise CheckpointError(
            f"'{path}' does not match its card: sha256 {digest[:16]}..., card says {expected[:16]}...; "
            f"the file is damaged or belongs to another card; fetch or export both again"
        )
    return path


def read_weights(name_or_path: str | Path) -> tuple[NetworkConfig, dict[str, NDArray[Any]], WeightCard]:
    """Architecture, tensors by name and card of a weight file.

    Args:
        name_or_path: a .safetensors file with its card beside it, or the name of weights that ship with
            the package.

    Raises:
        CheckpointError: not found, card missing or malformed, hash differs, or an unknown architecture.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    path = check_weights(name_or_path)
    card = read_card(path)
    try:
        config = build_config(NetworkConfig, card.architecture, f"architecture in '{card_path(path)}'")
        return config, load(path.read_bytes()), card
    except (ConfigError, SafetensorError) as error:
        raise CheckpointError(f"'{path}': {error}") from None


def read_card(path: str | Path) -> WeightCard:
    """The card beside a weight file. Raises CheckpointError: missing, unreadable, or of another format or version."""
    place = card_path(Path(path))
    try:
        values = parse_json(place.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MissingWeightsError(
            f"'{path}' has no card: '{place}' is missing; keep both files together"
        ) from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"card '{place}' cannot be read: {error}") from None
    if not isinstance(values, dict) or values.pop("format", None) != CARD_FORMAT:
        raise CheckpointError(f"'{place}' is no card of geomoe3d weights")
    if (version := values.pop("version", None)) != CARD_VERSION:
        raise CheckpointError(f"card '{place}' has version {version}; this geomoe3d reads {CARD_VERSION}")
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
