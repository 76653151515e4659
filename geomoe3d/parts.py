"""Parts that plug in: what they have in common, a registry for each kind, and names that are anybody's code.

Descriptor, matcher, outlier filter, estimator, scorer and refiner are parts: each kind has a base class and a
registry in the file ``base.py`` of its room. A part of the package joins by a decorator,

    @descriptor("fpfh")
    class Fpfh(Descriptor): ...

and a user's own by its name wherever a name is asked for: ``file.py:Class`` or ``package.module:Class``.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
from abc import ABC
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from geomoe3d.config import PartConfig
from geomoe3d.errors import ConfigError
from geomoe3d.runtime.sources import source_hash

if TYPE_CHECKING:
    from typing_extensions import Self

PartType = TypeVar("PartType", bound="Part")


class Part(ABC):  # noqa: B024 - what is abstract differs from kind to kind
    """Anything that plugs into the method; derive from the base class of a kind, not from this one."""

    @classmethod
    def from_config(cls, config: Any) -> Self:
        """Made from its section of the configuration: ``options`` become keyword arguments. Raises
        ConfigError: options that it does not take."""
        options = dict(config.options)
        try:
            inspect.signature(cls).bind(**options)
        except TypeError as error:
            raise ConfigError(f"'{config.name}' does not take these options {options}: {error}") from None
        return cls(**options)

    def warm_up(self) -> None:  # noqa: B027 - most have nothing to do
        """Load what is slow to load; else it is loaded when the part is first used."""

    def identity(self) -> dict[str, Any]:
        """What makes its answers differ from those of another: class, settings, and a hash of its code.

        Settings are the fields of a dataclass, else the attributes without a leading underscore.
        """
        values = (
            {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
            if dataclasses.is_dataclass(self)
            else {k: v for k, v in vars(self).items() if not k.startswith("_")}
        )
        kind = type(self)
        settings = {key: _plain(value) for key, value in values.items()}
        return {
            "part": f"{kind.__module__.rpartition('.')[2]}:{kind.__qualname__}",
            "settings": settings,
            "code": source_hash(kind.__module__),
        }


class Registry(Generic[PartType]):
    """The parts of one kind by name.

    Args:
        kind: what to call them in messages.
        room: package whose modules hold those that come with geomoe3d; imported when a name is first asked for.
        base: class that they all derive from, asked for when it is needed.
    """

    def __init__(self, kind: str, room: str, base: Callable[[], type[PartType]]) -> None:
        self.kind = kind
        self._room, self._base = room, base
        self._found: dict[str, type[PartType]] = {}
        self._complete = False

    def __call__(self, *names: str) -> Callable[[type[PartType]], type[PartType]]:
        """Decorator: the class is known by these names."""

        def add(part: type[PartType]) -> type[PartType]:
            for name in names:
                known = self._found.get(name)
                if known is not None and known.__qualname__ != part.__qualname__:
                    raise ValueError(f"two of kind {self.kind} are called '{name}'")
                self._found[name] = part
            return part

        return add

    def names(self) -> list[str]:
        """Names of the parts that come with geomoe3d and of those that were registered since."""
        if not self._complete:
            for module in pkgutil.iter_modules(importlib.import_module(self._room).__path__):
                importlib.import_module(f"{self._room}.{module.name}")
            self._complete = True
        return sorted(self._found)

    def find(self, name: str) -> type[PartType]:
        """The class that a name means.

        Args:
            name: one of `names`, ``file.py:Class`` or ``package.module:Class``.

        Raises:
            ConfigError: there is none (the message gives the nearest name), or it is of another kind.
        """
        if name in self._found:
            return self._found[name]
        if ":" in name:
            return self._own(name)
        if name in self.names():
            return self._found[name]
        close = difflib.get_close_matches(name, self.names(), n=1, cutoff=0.4)
        hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(self.names())}."
        raise ConfigError(
            f"unknown {self.kind} '{name}'; {hint} A class of your own is written file.py:Class or module:Class"
        )

    def make(self, config: PartConfig) -> PartType:
        """The part that a section of the configuration names, with its settings. Raises ConfigError: as
        `find`, or settings that it does not take."""
        part = self.find(config.name)
        own = part.from_config.__func__ is Part.from_config.__func__  # type: ignore[attr-defined]
        if config.options and not own and ":" not in config.name:
            raise ConfigError(
                f"options {dict(config.options)} are given, but the {self.kind} '{config.name}' takes none; they are "
                "for a class of your own"
            )
        return part.from_config(config)

    def _own(self, name: str) -> type[PartType]:
        found, base = load_object(name, f"a {self.kind}"), self._base()
        if not (isinstance(found, type) and issubclass(found, base)):
            raise ConfigError(
                f"'{name}' is no {self.kind}: derive the class from {base.__module__}.{base.__name__}"
            )
        if inspect.isabstract(found):
            missing = ", ".join(sorted(found.__abstractmethods__))
            raise ConfigError(
                f"'{name}' is not complete: it lacks {missing}; see {base.__module__}.{base.__name__}"
            )
        return found


def load_object(spec: str, what: str) -> Any:
    """What ``file.py:name`` or ``package.module:name`` means.

    Args:
        spec: as written by a user.
        what: what it is to be, for messages, such as "a descriptor".

    Raises:
        ConfigError: the file or module is missing or fails as it is imported, or holds no such name.
    """
    place, _, name = spec.rpartition(":")
    if not (place and name):
        raise ConfigError(f"'{spec}' names no code of yours to be {what}; write file.py:NAME or module:NAME")
    module = _load_file(place, what) if place.endswith(".py") else _import(place, name)
    try:
        return getattr(module, name)
    except AttributeError:
        names = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        close = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
        hint = f"did you mean '{close[0]}'?" if close else f"it holds: {', '.join(names) or 'none'}"
        raise ConfigError(f"'{place}' holds no '{name}' to be {what}; {hint}") from None


def _load_file(place: str, what: str) -> ModuleType:
    """The module in a file; its folder joins the search path, so that it finds its neighbours."""
    path = Path(place).resolve()
    if not path.is_file():
        raise ConfigError(f"no file '{place}' to take {what} from")
    content = hashlib.sha256(str(path).encode() + path.read_bytes()).hexdigest()[:12]
    name = f"geomoe3d_part_{path.stem}_{content}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"'{place}' cannot be imported as Python")
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    sys.modules[name] = module  # dataclasses and pickle look their module up
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise ConfigError(f"'{place}' fails as it is imported: {type(error).__name__}: {error}") from error
    return module


def _import(place: str, name: str) -> ModuleType:
    try:
        return importlib.import_module(place)
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"module '{place}' cannot be imported: {type(error).__name__}: {error}; for a file of your own "
            f"write its path, e.g. ./mine.py:{name}"
        ) from error


def _plain(value: Any) -> Any:
    """Something that JSON can write and that is equal where the value is."""
    if isinstance(value, (str, int, float, bool, type(None))):
        return value
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return repr(value)
