"""Options that every verb that registers pairs has: its configuration with the parts in it, and its workers."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

_PARTS = (
    ("descriptor", "descriptor.name", "Features of each point: fpfh, multiscale or learned. [fpfh]"),
    ("matcher", "matching.name", "one_way, mutual, ratio or dual_softmax. [one_way]"),
    ("filter", "filter.name", "Outlier rejection: none, spectral, or a network. [none]"),
    ("estimator", "estimator.name", "consensus, ransac or svd. [consensus]"),
    ("refiner", "refinement.name", "gicp, icp, svd or none. [gicp]"),
)


_SETTINGS = (
    ("--voxel-size", "voxel_size", "LENGTH", "Edge of the voxel grid, in the clouds' unit. [chosen]"),
    ("--seed", "seed", "N", "Random seed: the same seed, the same answers. [0]"),
    ("--config", "config_file", "FILE", "Configuration (YAML); `geomoe3d config` prints one."),
)


def worker_options(command: Command) -> Command:
    """Adds ``--workers`` and ``--scheduler``."""
    scheduler = click.option(
        "--scheduler", metavar="ADDRESS", help="Use the workers of a Dask cluster instead."
    )(command)
    result: Command = click.option(
        "--workers",
        type=click.IntRange(1),
        metavar="N",
        help="Parallel processes on this machine. [as many as cores and memory allow]",
    )(scheduler)
    return result


def scale_option(command: Command) -> Command:
    """Adds ``--estimate-scale``, for verbs with `configuration_options`."""
    result: Command = click.option(
        "--estimate-scale",
        is_flag=True,
        help="The ratio of the clouds' lengths is unknown (1/1000 to 1000): estimate it too.",
    )(command)
    return result


def unit_option(command: Command) -> Command:
    """Adds ``--unit``."""
    result: Command = click.option(
        "--unit",
        metavar="NAME",
        default="",
        help="Name of the files' unit of length, such as m; shown behind lengths, nothing is converted.",
    )(command)
    return result


def sensor_place(text: str | None, option: str) -> Any:
    """What a user says of a sensor: three numbers, ``none``, or None for nothing."""
    if text is None or text.strip().lower() == "none":
        return None if text is None else "none"
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(
            f"'{text}' is no place; give X,Y,Z in the file's coordinates, or none", param_hint=option
        ) from None
    return x, y, z


def cache_options(command: Command) -> Command:
    """Adds ``--cache`` and ``--no-cache``; the command gets ``cache``, empty for none."""

    @wraps(command)
    def with_cache(*args: Any, **named: Any) -> Any:
        if named.pop("no_cache"):
            named["cache"] = ""
        return command(*args, **named)

    none: Any = click.option("--no-cache", is_flag=True, help="Cache no features: compute them anew.")(
        with_cache
    )
    result: Command = click.option(
        "--cache", metavar="FOLDER", help="Where features are cached. [the user's cache folder]"
    )(none)
    return result


def method_part_options(command: Command) -> Command:
    """Adds ``--descriptor`` and its like; the command finds what they come to at the end of its ``assignments``.

    A part is a name or a class of the user's own, ``file.py:Class`` or ``module:Class``.
    """

    @wraps(command)
    def with_parts(*args: Any, **named: Any) -> Any:
        given = [(option, key, named.pop(f"part_{option}")) for option, key, _ in _PARTS]
        given = [(option, key, value) for option, key, value in given if value is not None]
        scorers = named.pop("part_scorers")
        _check([(option, value) for option, _, value in given] + [("scorer", name) for name in scorers])
        chosen = [f"{key}={value}" for _, key, value in given]
        if scorers:
            chosen.append(f"scoring.scorers=[{', '.join(scorers)}]")
        named["assignments"] = (*named["assignments"], *chosen)
        return command(*args, **named)

    wrapped: Any = click.option(
        "--scorer",
        "part_scorers",
        metavar="NAME",
        multiple=True,
        help="What scores the hypotheses: surfaces, network, or your own; repeatable. [surfaces, network]",
    )(with_parts)
    for option, _, text in reversed(_PARTS):
        wrapped = click.option(f"--{option}", f"part_{option}", metavar="NAME", help=text)(wrapped)
    result: Command = wrapped
    return result


def configuration_options(command: Command) -> Command:
    """Adds the options; the command gets what they come to as ``config``, a `RegistrationConfig`.

    An option overrides ``--set``, which overrides the file.
    """

    @wraps(command)
    def with_config(*args: Any, **named: Any) -> Any:
        from geomoe3d.config import load_config

        settings = [(key, named.pop(key)) for key in ("voxel_size", "seed")]
        settings.append(("scale", "estimate" if named.pop("estimate_scale", False) else None))
        chosen = [f"{key}={value}" for key, value in settings if value is not None]
        file, assignments = named.pop("config_file"), named.pop("assignments")
        return command(*args, **named, config=load_config(file, [*assignments, *chosen]))

    wrapped: Any = click.option(
        "--set",
        "assignments",
        metavar="KEY=VALUE",
        multiple=True,
        help="One value of the configuration; repeatable.",
    )(method_part_options(with_config))
    for option, name, metavar, text in reversed(_SETTINGS):
        wrapped = click.option(option, name, metavar=metavar, help=text)(wrapped)
    result: Command = wrapped
    return result


def _check(names: list[tuple[str, str]]) -> None:
    """Whether there are such parts, before anything is read; nothing is loaded where none is named.

    Raises:
        ConfigError: there is none of a name.
    """
    if names:
        from geomoe3d.pipeline import REGISTRIES

        for option, name in names:
            REGISTRIES[option].find(name)
