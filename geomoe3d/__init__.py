"""geomoe3d: two scans in, the rigid transform out, and how far it can be relied on.

    import geomoe3d
    result = geomoe3d.register("source.ply", "target.ply")
    print(result.status, result.confidence)
    moved = result.apply(source_points)      # p_target = R p_source + t

Every public name is loaded when it is first used (PEP 562), so that importing the package is quick, quiet
and pulls in none of the heavy libraries below it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geomoe3d.batch.run import register_pairs
    from geomoe3d.clouds.io import load_points, save_points
    from geomoe3d.config import RegistrationConfig, load_config
    from geomoe3d.correspondence_registration import CorrespondenceResult, register_correspondences
    from geomoe3d.errors import (
        CheckpointError,
        ConfigError,
        DependencyError,
        EmptyCloudError,
        ExistingFileError,
        ForbiddenFileError,
        FormatError,
        GeoMoE3DError,
        InputError,
        MissingConfigError,
        MissingFileError,
        MissingWeightsError,
        NonFiniteError,
        OutputError,
    )
    from geomoe3d.maps.location import Location, Place
    from geomoe3d.maps.map import Map
    from geomoe3d.multiway.run import register_scans
    from geomoe3d.registration import Registrar, register
    from geomoe3d.result import RegistrationResult
    from geomoe3d.types import Correspondences, PointCloud

__version__ = "0.1.0"

__all__ = [
    "CheckpointError",
    "ConfigError",
    "CorrespondenceResult",
    "Correspondences",
    "DependencyError",
    "EmptyCloudError",
    "ExistingFileError",
    "ForbiddenFileError",
    "FormatError",
    "GeoMoE3DError",
    "InputError",
    "Location",
    "Map",
    "MissingConfigError",
    "MissingFileError",
    "MissingWeightsError",
    "NonFiniteError",
    "OutputError",
    "Place",
    "PointCloud",
    "Registrar",
    "RegistrationConfig",
    "RegistrationResult",
    "__version__",
    "load_config",
    "load_points",
    "register",
    "register_correspondences",
    "register_pairs",
    "register_scans",
    "save_points",
]

_HOME = {
    "Registrar": "registration",
    "register": "registration",
    "register_correspondences": "correspondence_registration",
    "CorrespondenceResult": "correspondence_registration",
    "Location": "maps.location",
    "Map": "maps.map",
    "Place": "maps.location",
    "register_pairs": "batch.run",
    "register_scans": "multiway.run",
    "RegistrationResult": "result",
    "RegistrationConfig": "config",
    "load_config": "config",
    "load_points": "clouds.io",
    "save_points": "clouds.io",
    "Correspondences": "types",
    "PointCloud": "types",
}


if not TYPE_CHECKING:  # a type checker that saw it would accept every misspelt name

    def __getattr__(name):
        if name not in __all__:
            raise AttributeError(_unknown(name))
        value = getattr(import_module(f"{__name__}.{_HOME.get(name, 'errors')}"), name)
        globals()[name] = value  # the next look-up does not come here
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _unknown(name: str) -> str:
    message = f"module 'geomoe3d' has no attribute '{name}'"
    if name.startswith("__"):  # probes of the interpreter and of tools; nobody reads the answer
        return message
    from difflib import get_close_matches

    close = get_close_matches(name, __all__, n=1)
    return message + (f"; did you mean '{close[0]}'?" if close else f"; public names: {', '.join(__all__)}")
