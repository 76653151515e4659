"""What a worker does: one pair, from two paths to a record, whatever goes wrong with it.

Everything that a worker needs comes with the task, so that a process of this machine and a worker of a
cluster are the same to it; the registrar is kept from task to task.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from geomoe3d.batch.table import PairRow
from geomoe3d.clouds.formats.registry import reader_names, use_part
from geomoe3d.config import RegistrationConfig, build_config
from geomoe3d.decision.answer import library_versions
from geomoe3d.errors import DependencyError, GeoMoE3DError, OutputError
from geomoe3d.features.cache import FeatureCache, default_cache_folder
from geomoe3d.registration import Registrar
from geomoe3d.result import RegistrationResult

SHARED_KEYS = ("config", "versions", "seed")
"""What all results of a batch have in common; kept once, in run.json."""


@dataclass(frozen=True)
class Settings:
    """What all tasks of a batch have in common.

    Attributes:
        config: the complete configuration as JSON.
        versions: of the deciding libraries as JSON; a worker with others is refused.
        cache: folder of described clouds; None: the user's own on the worker's machine; empty: none.
        readers: of the user's own, by name.
    """

    config: str
    versions: str
    cache: str | None
    readers: tuple[str, ...] = ()

    @classmethod
    def of(cls, config: RegistrationConfig, cache: str | None) -> Settings:
        """Those of this process."""
        versions = json.dumps(library_versions(), sort_keys=True)
        return cls(config.model_dump_json(), versions, cache, reader_names())


@dataclass(frozen=True)
class Task:
    """One pair to be registered somewhere; the fingerprint is that of its row and files."""

    row: PairRow
    fingerprint: str
    settings: Settings


def register_pair(task: Task) -> dict[str, Any]:
    """One pair registered: a record with a result, or with the reason why there is none. Raises
    DependencyError: this worker's libraries are other than those of the process that asks."""
    registrar = _registrar(task.settings)
    row = task.row
    result, error = None, None
    try:
        result = registrar.register(row.source, row.target, initial=row.matrix)
    except GeoMoE3DError as caught:
        error = str(caught)
    except MemoryError:
        error = "out of memory: fewer workers leave more to each; a larger voxel size needs less"
    except Exception as caught:  # a fault of the library must not cost the other pairs
        error = f"internal error: {type(caught).__name__}: {caught}"
    return as_record(row.id, task.fingerprint, result, error)


def make_ready(settings: Settings) -> None:
    """Have the registrar here that the tasks will need. Raises ConfigError, CheckpointError, DependencyError:
    as `Registrar`, or this worker's libraries are other than those of the process that asks."""
    _registrar(settings)


def as_record(
    name: str, fingerprint: str, result: RegistrationResult | None, error: str | None
) -> dict[str, Any]:
    """A finished pair as the journal keeps it."""
    plain: dict[str, Any] | None = None
    seconds = {}
    if result is not None:
        plain = json.loads(result.to_json(None))
        seconds = plain.pop("seconds")
        for key in SHARED_KEYS:
            plain.pop(key)
    return {"id": name, "fingerprint": fingerprint, "error": error, "result": plain, "seconds": seconds}


@lru_cache(maxsize=1)
def _registrar(settings: Settings) -> Registrar:
    here = json.dumps(library_versions(), sort_keys=True)
    if here != settings.versions:
        raise DependencyError(
            f"a worker runs other versions than this process, so its answers could differ: {here} there, "
            f"{settings.versions} here; install the same everywhere"
        )
    for name in settings.readers:
        use_part("reader", name)
    config = build_config(RegistrationConfig, json.loads(settings.config))
    return Registrar(config, cache=open_cache(settings.cache))


def open_cache(folder: str | None) -> FeatureCache | None:
    """The cache in a folder; None: the user's own; empty, or a folder that cannot be made: none."""
    place = default_cache_folder() if folder is None else folder
    if not place:
        return None
    try:
        return FeatureCache(place)
    except OutputError as error:
        warnings.warn(f"features are not cached: {error}", RuntimeWarning, stacklevel=2)
        return None
