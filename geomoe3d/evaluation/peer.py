"""What all of other people's methods share: recentring, settings, versions, and being absent.

A peer is a function of two clouds or of corresponding points and its settings, registered by the decorator
`peer`. A library is imported when its peer is asked for; one that is not installed, or cannot be loaded,
makes the peer absent, never a failure. Clouds and correspondences are recentred first, because some of
these libraries compute in single precision. Place: below `peers` and `open3d_peers`.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.evaluation.records import Answer, MethodInput
from geomoe3d.geometry.se3 import make_transform, project_to_so3, shift_frames
from geomoe3d.runtime.sources import source_hash

CORRESPONDENCES = frozenset({"correspondences"})
CLOUDS = frozenset({"clouds"})

Register = Callable[..., Answer]
"""Source (N, 3), target (M, 3), both recentred, the `MethodInput` (thresholds, voxel size, seed), settings by
name -> answer."""

PEERS: dict[str, Peer] = {}
"""Peers by the name of the command line; complete once `geomoe3d.evaluation.peers` is imported."""


@dataclass
class Peer:
    """Another method as a `Method`.

    Attributes:
        name: as on the command line.
        module: what is imported.
        distributions: whose versions decide the answers; those that are not installed are left out.
        inputs: as in `Method`.
        register: the method itself.
        settings: its keywords.
        local: both clouds are shifted alike, so that the start stays the identity of the files' own
            coordinates.
        limits: where the library can be installed, if not everywhere.
    """

    name: str
    module: str
    distributions: tuple[str, ...]
    inputs: frozenset[str]
    register: Register
    settings: dict[str, Any]
    local: bool = False
    limits: str = ""

    def identity(self) -> dict[str, Any]:
        """Settings, versions of the libraries, and the hash of the code that defines the peer."""
        return {
            "settings": self.settings,
            "versions": versions("numpy", *self.distributions),
            "source_sha256": source_hash(self.register.__module__),
        }

    def absent(self) -> str | None:
        """Which library is missing or cannot be loaded, how to install it; None where the peer can run."""
        install = f"pip install {self.distributions[0]}" + (f" ({self.limits})" if self.limits else "")
        if importlib.util.find_spec(self.module) is None:
            return f"'{self.name}' needs {self.distributions[0]}, which is not installed: {install}"
        try:
            importlib.import_module(self.module)
        except (ImportError, OSError, AttributeError, RuntimeError) as error:
            # Say, a shared library of the system is missing, or it was built for another numpy.
            reason = " ".join(str(error).split())
            return (
                f"'{self.name}' needs {self.distributions[0]}, which is installed but cannot be loaded "
                f"({reason}): {install}"
            )
        return None

    def __call__(self, given: MethodInput) -> Answer:
        """Register one pair; see `Method`. Raises InputError: the pair comes without the input that this peer
        takes, or the library refuses it."""
        if given.correspondences is not None and "correspondences" in self.inputs:
            source, target = given.correspondences[:, :3], given.correspondences[:, 3:]
        elif given.source is not None and given.target is not None and "clouds" in self.inputs:
            source, target = given.source, given.target
        else:
            raise InputError(f"{given.pair}: '{self.name}' takes {' or '.join(sorted(self.inputs))}")
        if min(len(source), len(target)) < 3:
            return Answer(None)
        far = choose_origin(target)
        origins = (far if self.local else choose_origin(source)), far
        try:
            answer = self.register(source - origins[0], target - origins[1], given, **self.settings)
        except GeoMoE3DError:
            raise
        except Exception as error:  # a library's complaint of one pair must not end all the others
            raise InputError(f"{given.pair}: '{self.name}': {type(error).__name__}: {error}") from error
        T = answer.T_target_source
        if T is None or not np.isfinite(T).all():
            return Answer(None, inliers=answer.inliers, stages=answer.stages)
        T = make_transform(project_to_so3(T[:3, :3]), T[:3, 3])
        return Answer(shift_frames(T, *origins), inliers=answer.inliers, stages=answer.stages)


def peer(
    name: str,
    module: str,
    *distributions: str,
    inputs: frozenset[str],
    local: bool = False,
    limits: str = "",
    **settings: Any,
) -> Callable[[Register], Register]:
    """Registers a function as a peer, see `Peer`; its settings are the function's keywords and these."""

    def add(register: Register) -> Register:
        keywords = inspect.signature(register).parameters.values()
        defaults = {k.name: k.default for k in keywords if k.kind is inspect.Parameter.KEYWORD_ONLY}
        found = {**defaults, **settings}
        PEERS[name] = Peer(name, module, distributions, inputs, register, found, local, limits)
        return register

    return add


def versions(*distributions: str) -> dict[str, str]:
    """Versions of those distributions that are installed."""
    found = {}
    for name in distributions:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
