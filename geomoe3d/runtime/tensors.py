"""Weights of the small networks that run in numpy."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from geomoe3d.errors import CheckpointError
from geomoe3d.types import Float32Array


@cache
def read_tensors(
    path: Path, network: str, layer: str, shape: tuple[int | None, int | None]
) -> dict[str, Float32Array]:
    """The tensors of a .safetensors file by name, float32; read once.

    Args:
        path: the file.
        network: what it is to hold, for messages.
        layer: a tensor by which such a file is known.
        shape: of that tensor; None: any.

    Raises:
        CheckpointError: no such file, it is damaged, or it holds another network.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        found = load_file(path)
    except FileNotFoundError:
        raise CheckpointError(f"no weights of {network} at '{path}'") from None
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"weights of {network} '{path}' cannot be read: {error}") from None
    held = found[layer].shape if layer in found else ()
    if len(held) != 2 or any(want not in (None, has) for want, has in zip(shape, held, strict=True)):
        raise CheckpointError(f"'{path}' holds no weights of {network}")
    return {name: tensor.astype(np.float32) for name, tensor in found.items()}
