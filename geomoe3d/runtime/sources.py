"""What code decides an answer: a hash over a module and all of the package that it imports, however far.

Caches and evaluations are guarded by it, so that nothing of an older version is taken for that of a newer one,
and nobody has to keep lists of files. Imports are read from the text, also those inside functions; a part that
is plugged in by name is no import, so every part brings a hash of its own (`geomoe3d.parts`).
"""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Iterator
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import find_spec
from pathlib import Path

_PACKAGE = __name__.partition(".")[0]


@lru_cache(maxsize=256)
def source_hash(module: str) -> str:
    """Hexadecimal hash over the source of a module and of what it imports from the package.

    Args:
        module: dotted name of an importable module, of the package or anybody's.
    """
    total = hashlib.sha256()
    for name in sorted(source_closure(module)):
        total.update(name.encode() + b"\0" + hashlib.sha256(source_file(name).read_bytes()).digest())
    return total.hexdigest()


@lru_cache(maxsize=256)
def source_closure(module: str) -> frozenset[str]:
    """The module and every module of the package that it imports, directly or through others."""
    found: set[str] = set()
    wanted = [module]
    while wanted:
        name = wanted.pop()
        if name not in found:
            found.add(name)
            wanted += [other for other in _imports(name) if other.startswith(f"{_PACKAGE}.")]
    return frozenset(found)


@lru_cache(maxsize=64)
def library_versions(modules: frozenset[str]) -> dict[str, str]:
    """Installed version of every distribution that one of the modules imports, beside the standard library."""
    tops = {other.partition(".")[0] for name in modules for other in _imports(name)}
    tops -= {_PACKAGE, *sys.stdlib_module_names}
    owners = packages_distributions()
    found: dict[str, str] = {}
    for distribution in sorted({owner for top in tops for owner in owners.get(top, [top])}):
        try:
            found[distribution] = version(distribution)
        except PackageNotFoundError:
            continue
    return found


def source_file(module: str) -> Path:
    """The file that a module was or would be loaded from. Raises ModuleNotFoundError: there is none, as for a
    module without source."""
    loaded = sys.modules.get(module)
    place = getattr(loaded, "__file__", None)
    if place is None:
        spec = find_spec(module)
        place = None if spec is None else spec.origin
    if place is None:
        raise ModuleNotFoundError(f"no source of module '{module}'")
    return Path(place)


@lru_cache(maxsize=512)
def _imports(module: str) -> tuple[str, ...]:
    """Modules that a module names in its imports; those for type checkers alone are left out."""
    return tuple(sorted(set(_read(ast.parse(source_file(module).read_bytes())))))


def _read(tree: ast.AST) -> Iterator[str]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if _is_module(alias.name))
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from _from(node.module, [alias.name for alias in node.names])
        yield from _read(node)


def _from(module: str, names: list[str]) -> Iterator[str]:
    """``from module import names``: the module, or those of its names that are modules themselves."""
    if module.partition(".")[0] != _PACKAGE:
        yield module
        return
    inner = [f"{module}.{name}" for name in names if _is_module(f"{module}.{name}")]
    yield from inner
    if module == _PACKAGE:
        homes = vars(sys.modules[_PACKAGE]).get("_HOME", {})
        yield from (f"{_PACKAGE}.{homes[name]}" for name in names if name in homes)
    elif len(inner) < len(names):
        yield module


@lru_cache(maxsize=4096)
def _is_module(name: str) -> bool:
    """Of the package: whether there is such a file; of anything else it is taken for granted."""
    if name == _PACKAGE:
        return False
    top, _, rest = name.partition(".")
    if top != _PACKAGE:
        return True
    place = Path(sys.modules[_PACKAGE].__path__[0]) / rest.replace(".", "/")
    return place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()
