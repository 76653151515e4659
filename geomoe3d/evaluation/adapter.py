"""Your own method, evaluated by the rules of all others: a Python function of two arrays.

Copy this into ``mine.py`` and evaluate ``mine.py:register`` (or ``package.module:function``)::

    import numpy as np

    def register(source, target, *, seed=0):   # (N, 3) and (N, 3) float64, metres
        a, b = source - source.mean(0), target - target.mean(0)
        U, _, Vt = np.linalg.svd(a.T @ b)
        R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
        T = np.eye(4)                          # p_target = R p_source + t
        T[:3, :3], T[:3, 3] = R, target.mean(0) - R @ source.mean(0)
        return T                               # or None: no answer

On the correspondence tracks row i of one array belongs to row i of the other; on the track ``clouds`` they
are the points of two scans, (n, 3) and (m, 3). Keywords named ``seed``, ``voxel_size`` and
``inlier_threshold`` are filled in where the function takes them. An exception or a result that is no rigid
transform counts as a pair without an answer and is reported; only the file itself enters the identity of a
run, not what it imports. Cost: that of the function and one copy of its input.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import ConfigError, GeoMoE3DError, InputError
from geomoe3d.evaluation.records import Answer, MethodInput
from geomoe3d.geometry.se3 import check_motion
from geomoe3d.parts import load_object
from geomoe3d.types import FloatArray

_KEYWORDS = ("seed", "voxel_size", "inlier_threshold")


class AdaptedFunction:
    """A user's function as a `Method`.

    Args:
        spec: ``path/to/file.py:function`` or ``package.module:function``.

    Raises:
        InputError: no such file, module or function, the module fails as it is imported, or the name is not
            callable.
    """

    inputs = frozenset({"correspondences", "clouds"})

    def __init__(self, spec: str) -> None:
        self.name = spec
        if not all(spec.rpartition(":")[::2]):
            raise InputError(f"'{spec}' names no function; write file.py:function or package.module:function")
        try:
            found = load_object(spec, "a method")
        except ConfigError as error:
            raise InputError(str(error)) from error.__cause__
        if not callable(found):
            raise InputError(f"'{spec}' is a {type(found).__name__}, not a function")
        self._function = found
        self._source_hash = _hash(found)
        self._keywords = _accepted(found)

    def identity(self) -> dict[str, Any]:
        """The function, the hash of its file, and the version of numpy."""
        return {
            "function": self.name.rpartition(":")[2],
            "source_sha256": self._source_hash,
            "keywords": list(self._keywords),
            "versions": {"numpy": np.__version__},
        }

    def absent(self) -> str | None:
        """None: a function that cannot be loaded is an error at once."""
        return None

    def __call__(self, given: MethodInput) -> Answer:
        """Call the function on copies of the pair's arrays and check what it returns. Raises InputError: the
        function raised, or returned something that is no rigid transform."""
        if given.correspondences is not None:
            source, target = given.correspondences[:, :3].copy(), given.correspondences[:, 3:].copy()
        elif given.source is not None and given.target is not None:
            source, target = given.source.copy(), given.target.copy()
        else:
            raise InputError(f"{given.pair}: neither correspondences nor clouds were given")
        keywords = {name: getattr(given, name) for name in self._keywords}
        try:
            result = self._function(source, target, **keywords)
        except GeoMoE3DError as error:
            raise InputError(f"{given.pair}: '{self.name}': {error}") from error
        except (Exception, SystemExit) as error:
            where = _last_line(error)
            raise InputError(
                f"{given.pair}: '{self.name}' raised {type(error).__name__}: {error}{where}"
            ) from error
        return Answer(_motion(result, f"{given.pair}: '{self.name}'"))


def _motion(result: Any, who: str) -> FloatArray | None:
    """What a function returned as a rigid transform (4, 4); None and non-finite entries mean no answer.
    Raises InputError: see `geomoe3d.geometry.se3.check_motion`; ``who`` begins the message."""
    if result is None:
        return None
    try:
        if not np.isfinite(np.asarray(result, dtype=np.float64)).all():
            return None
        return check_motion(result)
    except (TypeError, ValueError, RuntimeError) as error:  # InputError is a ValueError
        raise InputError(f"{who} returned {_kind(result)}: {error}") from None


def _accepted(function: Callable[..., Any]) -> tuple[str, ...]:
    """Which of the keywords the function names; none where it has no readable signature."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return ()
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    names = {p.name for k, p in enumerate(parameters) if p.kind in named and k >= 2}
    return tuple(name for name in _KEYWORDS if name in names)


def _hash(function: Callable[..., Any]) -> str | None:
    """Of the file that the function was found in; None for one that was not written in a file."""
    file = getattr(inspect.getmodule(function), "__file__", None)
    return None if file is None else hashlib.sha256(Path(file).read_bytes()).hexdigest()


def _kind(result: Any) -> str:
    shape = getattr(result, "shape", None)
    return type(result).__name__ + ("" if shape is None else f" of shape {tuple(shape)}")


def _last_line(error: BaseException) -> str:
    """Where the error arose, as `` (file.py, line 12)``."""
    trace = error.__traceback__
    if trace is None:
        return ""
    while trace.tb_next is not None:
        trace = trace.tb_next
    return f" ({Path(trace.tb_frame.f_code.co_filename).name}, line {trace.tb_lineno})"
