"""Where weight files lie: paths, and names of what ships with the package; needs no torch."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from geomoe3d.errors import CheckpointError, MissingWeightsError

PACKAGED = Path(__file__).parent / "weights"
DEFAULT_WEIGHTS = "geomoe3d"
"""Name of the weights that ship with the package."""


def find_weights(name_or_path: str | Path) -> Path:
    """The file that a name or path means.

    Raises:
        CheckpointError: there is none; the message lists what ships with the package.
    """
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
    """Whether weights are of a network that judges transforms, by their card; False where there is no card.

    Raises:
        CheckpointError: no such weights.
    """
    card = find_weights(name_or_path).with_suffix(".json")
    try:
        architecture = json.loads(card.read_text(encoding="utf-8"))["architecture"]
        return "aligned" in architecture.get("extra_channels", ())
    except (OSError, ValueError, KeyError, AttributeError, TypeError):
        return False  # loading the weights says what is wrong with the card


def check_weights(name_or_path: str | Path) -> Path:
    """The file that a name or path means, whose content is what its card says; needs no torch.

    Raises:
        CheckpointError: not found, without a card, or damaged.
    """
    path = find_weights(name_or_path)
    place = path.with_suffix(".json")
    try:
        expected = json.loads(place.read_text(encoding="utf-8"))["sha256"]
    except FileNotFoundError:
        raise MissingWeightsError(
            f"'{path}' has no card: '{place}' is missing; keep both files together"
        ) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"card '{place}' cannot be read: {error}") from None
    if (digest := file_hash(path)) != expected:
        raise CheckpointError(
            f"'{path}' does not match its card: sha256 {digest[:16]}..., card says {str(expected)[:16]}...; "
            f"the file is damaged or belongs to another card; fetch or export both again"
        )
    return path


def file_hash(path: Path) -> str:
    """sha256 of a file, hexadecimal.

    Raises:
        CheckpointError: it cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CheckpointError(f"cannot read '{path}': {error.strerror or error}") from None
