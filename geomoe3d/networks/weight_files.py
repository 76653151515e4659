"""Where weight files lie: paths, and names of what ships with the package; needs no torch."""

from __future__ import annotations

from pathlib import Path

from geomoe3d.errors import CheckpointError

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
    raise CheckpointError(f"no weights '{name_or_path}': no such file, and packaged weights are: {names}")


def packaged_names() -> list[str]:
    """Names of the weights that ship with the package."""
    return sorted(path.stem for path in PACKAGED.glob("*.safetensors"))
