"""Options by which every verb that registers pairs takes parts: those that come with geomoe3d, or your own."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

_PARTS = (
    ("descriptor", "descriptor.name", "What describes the surface at each point. [fpfh]"),
    ("matcher", "matching.name", "one_way, mutual or ratio. [one_way]"),
    ("filter", "filter.name", "Outlier rejection: none, spectral, or a network. [none]"),
    ("estimator", "estimator.name", "consensus, ransac or svd. [consensus]"),
    ("refiner", "refinement.name", "gicp, icp, svd or none. [gicp]"),
)


def part_options(command: Command) -> Command:
    """Adds the options; the command gets them as ``parts``, a list of ``key=value`` of the configuration.

    Each takes a name or a class of the user's own, ``file.py:Class`` or ``module:Class``.
    """

    @wraps(command)
    def with_parts(*args: Any, **named: Any) -> Any:
        given = [(option, key, named.pop(f"part_{option}")) for option, key, _ in _PARTS]
        given = [(option, key, value) for option, key, value in given if value is not None]
        scorers = named.pop("part_scorers")
        _check([(option, value) for option, _, value in given] + [("scorer", name) for name in scorers])
        named["parts"] = [f"{key}={value}" for _, key, value in given]
        if scorers:
            named["parts"].append(f"scoring.scorers=[{', '.join(scorers)}]")
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


def _check(names: list[tuple[str, str]]) -> None:
    """Whether there are such parts, before anything is read; nothing is loaded where none is named.

    Raises:
        ConfigError: there is none of a name.
    """
    if names:
        from geomoe3d.pipeline import REGISTRIES

        for option, name in names:
            REGISTRIES[option].find(name)
