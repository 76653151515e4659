"""What the package is made of: lines per room, largest files, constants outside the configuration, circles.

    python scripts/measure_house.py [--constants]

A constant is a number, or a tuple, list, set or mapping of numbers, that is given a name at the level of a
module; ``config.py`` files and the package ``config``, which hold the configuration, are left out. What decides an
answer belongs there. The rest is of one of the kinds of `KINDS`; what no pattern of a kind fits counts as deciding. A
circle is a set of files each of which imports, directly or through others, all of the others; imports inside
functions count, those for type checkers alone do not.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "geomoe3d"

KINDS = {
    "of a file format, a protocol, a published data set or a version": (
        "data/splits.py:* data/fusion.py:*",
        "*:*VERSION *:_NO_DATA",
    ),
    "of mathematics, physics or rounding: three points fix a motion, millimetres in a metre, what avoids 0 / 0": (
        "*:_BITS *:_BINS *:_TINY *:*_UNITS *:OFF_ROUND *:_MIN_POINTS *:_depth *:MIN_MATCHES *:_LOOSEST",
    ),
    "of how an answer is shown, said or looked up": (
        "visual/*:* evaluation/report_*:* runtime/progress.py:*",
    ),
    "that an option of a verb sets, named in its help": ("multiway/defaults.py:*",),
    "of memory and time, by which the same answer is had: blocks, chunks, caches": (
        "*:*BLOCK *:*_AT_ONCE *:*BLOCK_ENTRIES *:_ROWS *:_PIECE batch/memory.py:*",
    ),
    "of a trained network, whose weights hold with them alone, or of a published architecture": (
        "networks/*:* features/learned.py:* features/pyramid.py:*",
        "maps/level.py:SPACING scoring/surface_channels.py:*",
    ),
    "of the protocol of a benchmark or of a measurement": (
        "evaluation/*:*",
        "data/statistics.py:*",
    ),
    "of the recipe of generated data or of a training, which its own settings and version identify": (
        "data/*:* training/*:*",
    ),
}
"""What the constants are that decide no answer of a registration: kind -> patterns ``file:name``, asked in order."""

DECIDING = {
    *("clouds", "features", "matching", "filters", "estimators", "scoring"),
    *("refinement", "decision", "geometry", "maps", "multiway"),
}
"""Folders in which a number is likely to decide an answer; those of networks go with their weights."""

DECIDES = "that decide an answer"


@click.command()
@click.option("--most", default=12, show_default=True, help="Largest files that are listed.")
@click.option("--constants", "list_constants", is_flag=True, help="List every constant with its place.")
def main(most: int, list_constants: bool) -> None:
    """Print what the package is made of."""
    files = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
    trees = {path: ast.parse(text) for path, text in files.items()}
    lines = {path: text.count("\n") for path, text in files.items()}
    rooms: dict[str, int] = {}
    for path, count in lines.items():
        parts = path.relative_to(PACKAGE).parts
        room = parts[0] if len(parts) > 1 else "(root)"
        rooms[room] = rooms.get(room, 0) + count
    for room, count in sorted(rooms.items(), key=lambda item: -item[1]):
        click.echo(f"{count:7,}  {room}")
    click.echo(f"{sum(lines.values()):7,}  lines in {len(files)} files\n")
    for path, count in sorted(lines.items(), key=lambda item: -item[1])[:most]:
        click.echo(f"{count:7,}  {path.relative_to(PACKAGE)}")
    by_kind = constants_by_kind(trees)
    count = sum(map(len, by_kind.values()))
    click.echo(f"\n{count:7,}  numeric constants of modules outside the configuration, of these")
    for kind, found in by_kind.items():
        click.echo(f"{len(found):11,}  {kind}")
        for place in found if list_constants else ():
            click.echo(f"             {place}")
    inside = [
        f"{path.relative_to(PACKAGE).as_posix()}:{line} {number}"
        for path, tree in trees.items()
        if path.parent.relative_to(PACKAGE).as_posix() in DECIDING
        for number, line in numbers_inside(tree)
    ]
    click.echo(f"{len(inside):7,}  decimal numbers inside functions that may decide an answer")
    for place in inside if list_constants else ():
        click.echo(f"             {place}")
    circles = import_circles(trees)
    click.echo(f"{len(circles):7,}  import circles between files")
    for circle in circles:
        click.echo(f"         {', '.join(circle)}")
    at_root = sorted(path.name for path in files if path.parent == PACKAGE)
    click.echo(f"{len(at_root):7,}  Python files at the package's root: {', '.join(at_root)}")


def constants_by_kind(trees: dict[Path, ast.Module]) -> dict[str, list[str]]:
    """``file:line name`` of every constant outside the configuration, by the kinds of `KINDS` and by `DECIDES`."""
    by_kind: dict[str, list[str]] = {DECIDES: [], **{kind: [] for kind in KINDS}}
    for path, tree in trees.items():
        if is_configuration(path):
            continue
        file = path.relative_to(PACKAGE).as_posix()
        for name, line in constants(tree):
            by_kind[kind_of(f"{file}:{name}")].append(f"{file}:{line} {name}")
    return by_kind


def is_configuration(path: Path) -> bool:
    """Whether a file holds the configuration, whose numbers are those that belong there."""
    return path.name == "config.py" or path.parent.name == "config"


def numbers_inside(tree: ast.Module) -> Iterator[tuple[float, int]]:
    """Value and line of the decimal numbers written in the bodies of functions: whether one decides has to be read.

    Whole ones, a half, and what only avoids 0 / 0 (up to 1e-5) are left out: formulas are full of them.
    """
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for node in (node for statement in function.body for node in ast.walk(statement)):
                if isinstance(node, ast.Constant) and isinstance(node.value, float):
                    value = node.value
                    if value > 1e-5 and value != 0.5 and not value.is_integer():
                        yield value, node.lineno


def kind_of(constant: str) -> str:
    """The kind of a constant, ``file:name``."""
    for kind, patterns in KINDS.items():
        if any(fnmatchcase(constant, pattern) for pattern in " ".join(patterns).split()):
            return kind
    return DECIDES


def constants(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Name and line of every numeric constant at the level of a module."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            targets, value = node.targets, node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            targets, value = [node.target], node.value
        else:
            continue
        for target in targets:
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            values = value.elts if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) else [value]
            for name, one in zip(names, values, strict=False):
                if isinstance(name, ast.Name) and is_numeric(one):
                    yield name.id, node.lineno


def is_numeric(node: ast.expr) -> bool:
    """Whether an expression is made of written numbers alone: arithmetic, tuples, values of a mapping."""
    match node:
        case ast.Constant(value=bool()):
            return False
        case ast.Constant(value=int() | float()):
            return True
        case ast.UnaryOp(operand=operand):
            return is_numeric(operand)
        case ast.BinOp(left=left, right=right):
            return is_numeric(left) and is_numeric(right)
        case ast.Tuple(elts=parts) | ast.List(elts=parts) | ast.Set(elts=parts) | ast.Dict(values=parts):
            return bool(parts) and all(map(is_numeric, parts))
        case ast.Call(args=[inside]):  # np.array([...]), frozenset({...})
            return is_numeric(inside)
    return False


def import_circles(trees: dict[Path, ast.Module]) -> list[list[str]]:
    """Every set of files that import each other, as module names."""
    names = {module_name(path): path for path in trees}
    graph = {name: set(imported(trees[path], names)) - {name} for name, path in names.items()}
    reach = {name: reachable(name, graph) for name in graph}
    circles = {
        frozenset(other for other in reach[name] if name in reach[other])
        for name in graph
        if name in reach[name]
    }
    return sorted(sorted(circle) for circle in circles)


def module_name(path: Path) -> str:
    """The module in a file of the package, such as ``geomoe3d.batch.run``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.Module, known: dict[str, Path]) -> Iterator[str]:
    """Modules of the package that a file imports when it is loaded or at work."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                yield inside if inside in known else node.module
        waiting += ast.iter_child_nodes(node)


def reachable(start: str, graph: dict[str, set[str]]) -> set[str]:
    """Everything that a module imports, directly or through others."""
    found: set[str] = set()
    waiting = [start]
    while waiting:
        for name in graph[waiting.pop()] - found:
            found.add(name)
            waiting.append(name)
    return found


if __name__ == "__main__":
    main()
