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
        given = {key: named.pop(f"part_{option}") for option, key, _ in _PARTS}
        scorers = named.pop("part_scorers")
        named["parts"] = [f"{key}={value}" for key, value in given.items() if value is not None]
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
