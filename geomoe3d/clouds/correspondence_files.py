"""Correspondences of a user's own from a file: six numbers a row, source xyz and target xyz."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomoe3d.errors import FormatError, cannot_read, plain_reason
from geomoe3d.runtime.words import shape_in_words
from geomoe3d.types import FloatArray


def load_correspondences(path: str | Path) -> FloatArray:
    """(N, 6) rows [source xyz, target xyz] of an .npy file, or of text with blanks or commas between numbers.
    Raises InputError: missing or unreadable; FormatError: another number of columns than six."""
    place = Path(path)
    try:
        if place.suffix.lower() == ".npy":
            rows = np.load(place, allow_pickle=False)
        else:
            text = place.read_text(encoding="utf-8").replace(",", " ").replace(";", " ")
            rows = np.loadtxt(text.splitlines(), ndmin=2)
        if rows.dtype.kind == "c":
            raise ValueError("complex numbers, expected real ones")
        found: FloatArray = np.asarray(rows, dtype=np.float64)
    except OSError as error:
        raise cannot_read(error, f"cannot read '{path}': {error.strerror or error}") from None
    except (ValueError, EOFError) as error:
        raise FormatError(
            f"'{path}' holds no rows of six numbers (x y z in the source, x y z in the target): {plain_reason(error)}"
        ) from None
    if found.ndim != 2 or found.shape[1] != 6:
        raise FormatError(
            f"'{path}' holds {shape_in_words(found.shape)}, expected six numbers a row: x y z in the source, x y z in "
            "the target"
        )
    return found
