"""Pickles and torch files of other projects, read without running what they contain.

A pickle may call anything while it loads. Here only what plain numpy arrays, numbers and containers need
is let through; everything else is refused by name. Files that ``torch.save`` wrote from arrays are read in
both of its formats (zip, and the older stream), without torch.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import FormatError, cannot_read, plain_reason

_ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("collections", "OrderedDict"): OrderedDict,
    ("builtins", "bytearray"): bytearray,
    ("builtins", "set"): set,
}
_ARRAY_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")
_NUMERIC_MODULES = ("numpy.core.numeric", "numpy._core.numeric")


def load_pickle(path: str | Path) -> Any:
    """The object of a pickle, or of a torch file that holds numpy arrays only. Raises InputError: the file
    cannot be opened; FormatError: it is no pickle, is cut short, or names anything beyond numpy arrays and
    containers."""
    path = Path(path)
    try:
        if zipfile.is_zipfile(path):
            return _load_torch_zip(path)
        with path.open("rb") as stream:
            first = _load(stream)
            # The number that a file of torch.save begins with.
            if not isinstance(first, int) or first != 0x1950A86A20F9469CFC6C:
                return first
            _load(stream), _load(stream)  # protocol version, description of the machine
            return _load(stream)
    except OSError as error:
        raise cannot_read(error, f"cannot read '{path}': {error.strerror or error}") from None
    except FormatError as error:
        raise FormatError(f"'{path}': {error}") from None
    except Exception as error:  # a damaged pickle raises nearly anything
        raise FormatError(f"'{path}' is no readable pickle: {plain_reason(error)}") from None


def _load_torch_zip(path: Path) -> Any:
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith("data.pkl")]
        if len(names) != 1:
            raise FormatError("a zip file without data.pkl is no torch file")
        return _load(io.BytesIO(archive.read(names[0])))


def _load(stream: Any) -> Any:
    return _Reader(stream, encoding="latin1").load()


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module in _ARRAY_MODULES and name in ("_reconstruct", "scalar"):
            return _reconstruct if name == "_reconstruct" else _scalar
        if module in _NUMERIC_MODULES and name == "_frombuffer":
            return _from_buffer
        if (module, name) == ("_codecs", "encode"):
            return _encode
        found = _ALLOWED.get((module, name))
        if found is None:
            raise FormatError(f"holds '{module}.{name}', which is not loaded; only numpy arrays are")
        return found

    def persistent_load(self, identifier: Any) -> Any:
        raise FormatError("holds torch tensors; only files of numpy arrays are read")


def _reconstruct(kind: Any, shape: Any, code: Any) -> Any:
    return np.ndarray.__new__(np.ndarray, (0,), dtype="b")


def _from_buffer(data: Any, dtype: np.dtype[Any], shape: Any, order: Any) -> Any:
    if dtype.hasobject:
        raise FormatError("holds an object array in raw form, which is not loaded")
    return np.frombuffer(data, dtype=dtype).reshape(shape, order="F" if order == "F" else "C")


def _scalar(dtype: np.dtype[Any], data: Any) -> Any:
    raw = data.encode("latin1") if isinstance(data, str) else data
    if dtype.hasobject:
        raise FormatError("holds an object scalar, which is not loaded")
    return np.frombuffer(raw, dtype=dtype, count=1)[0]


def _encode(text: str, encoding: str = "latin1") -> bytes:
    return text.encode("latin1" if encoding == "latin1" else "utf-8")
