"""Configurations from YAML, mappings and ``key=value``; an unknown key is an error that names the nearest known one."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any, TypeVar, get_origin

from pydantic import ValidationError

from geomoe3d.config.section import Section
from geomoe3d.config.sections import MOVED, RegistrationConfig
from geomoe3d.errors import ConfigError, MissingConfigError, plain_reason

S = TypeVar("S", bound=Section)

_INSTALLED = Path(__file__).parents[1] / "configs"  # in a checkout they stand beside the package
_CONFIGS = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).parents[2] / "configs"


_KINDS = {
    "tuple_type": "it must be a list in brackets, such as [a, b], or [] for none",
    "dict_type": "it must be pairs of name and value in braces, such as {a: 1, b: 2}, or {} for none",
    "string_": "it must be text",
    "float_": "it must be a number",
    "int_": "it must be a whole number",
    "bool_": "it must be true or false",
}
"""What pydantic says of a value of the wrong kind (the beginning of the error's type), in words without Python."""


def known_keys(section: type[Section], prefix: str = "") -> list[str]:
    """Dotted names of every leaf of a configuration tree, in declaration order."""
    keys: list[str] = []
    for name, info in section.model_fields.items():
        kind = info.annotation
        generic = get_origin(kind) is not None  # Python 3.10 takes list[int] for a type
        if not generic and isinstance(kind, type) and issubclass(kind, Section):
            keys += known_keys(kind, f"{prefix}{name}.")
        else:
            keys.append(prefix + name)
    return keys


def build_config(section: type[S], tree: dict[str, Any] | None, where: str = "configuration") -> S:
    """Validate a nested mapping into a configuration.

    Args:
        section: the class of the root.
        tree: nested mapping as YAML gives it; None or empty means all defaults.
        where: what to call the source in messages.

    Raises:
        ConfigError: an unknown key (names the nearest known one) or a value out of its range.
    """
    if tree is not None and not isinstance(tree, dict):
        raise ConfigError(f"{where}: expected sections of 'key: value', found {_kind(tree)}")
    try:
        return section.model_validate(tree or {})
    except ValidationError as error:
        raise ConfigError(f"{where}: {_explain(error, section)}") from None


def parse_yaml(text: str) -> Any:
    """As `yaml.safe_load`. Raises yaml.YAMLError: the text is no YAML, or is nested too deeply."""
    import yaml

    try:
        return yaml.safe_load(text)
    except RecursionError:
        raise yaml.YAMLError("its brackets are nested too deeply") from None
    except ValueError as error:  # such as the 45th of a month
        raise yaml.YAMLError(str(error)) from None


def set_keys(tree: dict[str, Any], assignments: list[str]) -> dict[str, Any]:
    """Apply ``a.b=value`` strings (value parsed as YAML) to a copy of a nested mapping. Raises ConfigError:
    an assignment without ``=`` or through a key that is no section."""
    import copy

    import yaml

    result = copy.deepcopy(tree)
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"'{assignment}' is no assignment; write key=value, e.g. estimator.name=ransac")
        node = result
        *parents, leaf = key.strip().split(".")
        for parent in parents:
            child = node.setdefault(parent, {})
            if not isinstance(child, dict):
                raise ConfigError(f"'{assignment}': '{parent}' holds a value, not a section")
            node = child
        try:
            node[leaf] = parse_yaml(text)
        except yaml.YAMLError as error:
            raise ConfigError(f"'{assignment}': the value cannot be read ({plain_reason(error)})") from None
    return result


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read one YAML mapping; ``configs/...`` are those that come with the package, wherever it is called.
    Raises ConfigError: the file is missing, unreadable, no YAML, or holds no mapping."""
    import yaml

    try:
        text = _shipped(Path(path)).read_text(encoding="utf-8")
        tree = parse_yaml(text)
        twice = _twice(yaml.compose(text, yaml.SafeLoader))
    except FileNotFoundError as error:
        names = [str(file.relative_to(_CONFIGS.parent)) for file in sorted(_CONFIGS.rglob("*.yaml"))]
        close = difflib.get_close_matches(str(path), names, n=1, cutoff=0.75)
        hint = f"; did you mean {close[0]}, which comes with geomoe3d?" if close else ""
        if Path(path).as_posix().endswith("train/motions.yaml"):
            hint = "; it is now configs/train/transforms.yaml"
        raise MissingConfigError(f"cannot read configuration '{path}': {error.strerror}{hint}") from None
    except OSError as error:
        raise ConfigError(f"cannot read configuration '{path}': {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"'{path}' is no configuration (YAML): {plain_reason(error)}") from None
    if twice:
        raise ConfigError(f"'{path}' gives '{twice[0]}' more than once; keep one of them")
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(
            f"'{path}' holds {_kind(tree)}, expected lines of 'key: value' as `geomoe3d config` prints them"
        )
    return tree


def _kind(value: object) -> str:
    """What YAML that is no mapping holds, in words."""
    return "a list" if isinstance(value, list) else "text" if isinstance(value, str) else f"'{value}'"


def yaml_text(section: Section) -> str:
    """A whole configuration as YAML, without comments; `read_yaml` reads it."""
    import yaml

    return yaml.safe_dump(section.model_dump(mode="json"), sort_keys=False)


def _twice(node: Any, prefix: str = "") -> list[str]:
    """Keys that stand more than once in one mapping of a YAML document, of which YAML silently takes the last."""
    found: list[str] = []
    names: set[str] = set()
    for key, value in node.value if node is not None and node.id == "mapping" else ():
        name = f"{prefix}{key.value}"
        found += [name] if name in names else []
        names.add(name)
        found += _twice(value, f"{name}.")
    return found


def _shipped(path: Path) -> Path:
    """The file itself; where there is none, the one of that name among those that come with the package."""
    return path if path.exists() or path.is_absolute() else _CONFIGS.parent / path


def load_config(path: str | Path | None = None, assignments: list[str] | None = None) -> RegistrationConfig:
    """The registration configuration of a YAML file (None: defaults) with ``key=value`` overrides."""
    tree = read_yaml(path) if path is not None else {}
    return build_config(RegistrationConfig, set_keys(tree, assignments or []), str(path or "configuration"))


def _explain(error: ValidationError, section: type[Section]) -> str:
    parts = []
    for problem in error.errors():
        key = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            inner = problem["input"]
            while key not in MOVED and isinstance(inner, dict) and inner:  # a section: by a key in it
                name, inner = next(iter(inner.items()))
                key += f".{name}"
            hint = f"it is now {MOVED[key]}" if key in MOVED else _nearest(key, known_keys(section))
            parts.append(f"unknown key '{key}'; {hint}")
        elif problem["type"] in ("model_type", "model_attributes_type"):
            inside = [name for name in known_keys(section) if name.startswith(f"{key}.")]
            meant = f"{key}.name" if f"{key}.name" in inside else ", ".join(inside)
            parts.append(f"'{key}' is a section, found {problem['input']!r}; did you mean {meant}?")
        else:
            said = problem["msg"].removeprefix("Value error, ").replace("Input should be", "it must be")
            kind = next((words for start, words in _KINDS.items() if problem["type"].startswith(start)), said)
            parts.append(f"'{key}' = {_shown(problem['input'])}: {kind}")
    return "; ".join(parts)


def _shown(value: Any) -> str:
    """A value as YAML writes it, where Python has a word of its own."""
    return str(value).lower() if isinstance(value, bool) else "null" if value is None else repr(value)


def _nearest(key: str, keys: list[str]) -> str:
    close = difflib.get_close_matches(key, keys, n=1, cutoff=0.4)
    if not close:  # the leaf alone often matches where the section was forgotten
        leaves = {name.rsplit(".", 1)[-1]: name for name in keys}
        close = [leaves[m] for m in difflib.get_close_matches(key.rsplit(".", 1)[-1], list(leaves), n=1)]
    if close:
        return f"did you mean '{close[0]}'?"
    known = dict.fromkeys(name.split(".")[0] for name in keys)
    more = "; `geomoe3d config --all` lists all keys" if "expert" in known else ""
    return f"known here: {', '.join(known)}{more}"
