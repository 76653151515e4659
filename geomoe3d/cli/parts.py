"""Options that several verbs have: the configuration with the parts in it, the workers, the cache."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])
Option = Callable[[Callable[..., Any]], Callable[..., Any]]

_PARTS = (
    ("descriptor", "descriptor.name", "Features of each point: fpfh, multiscale or learned. [fpfh]"),
    ("matcher", "matching.name", "How points are matched: one_way, mutual, ratio or dual_softmax. [one_way]"),
    ("filter", "filter.name", "Outlier rejection: none, spectral, or a network. [none]"),
    ("estimator", "estimator.name", "What proposes transforms: consensus, ransac or svd. [consensus]"),
    ("refiner", "refinement.name", "What refines them: gicp, icp, svd or none. [gicp]"),
)


class Number(click.ParamType):  # type: ignore[type-arg]  # older click has no such arguments
    """A finite number within limits, which an error says in words; help shows the metavar alone."""

    def __init__(
        self,
        least: float | None = None,
        most: float | None = None,
        *,
        above: float | None = None,
        whole: bool = True,
    ) -> None:
        self.least, self.most, self.above, self.whole = least, most, above, whole
        self.name = "n" if whole else "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number that a text is; fails with what is allowed."""
        try:
            found = int(value) if self.whole else float(value)
        except ValueError:
            found = math.nan
        least, most, above = (x if x is not None else y for x, y in (
            (self.least, -math.inf), (self.most, math.inf), (self.above, -math.inf)))  # fmt: skip
        if math.isfinite(found) and least <= found <= most and (found > above or self.above is None):
            return found
        limits = [
            f"{word} {limit:.17g}"
            for word, limit in (
                ("at least", self.least),
                ("at most", self.most),
                ("greater than", self.above),
            )
            if limit is not None
        ]
        allowed = ", ".join(["a whole number" if self.whole else "a number", " and ".join(limits)]).rstrip(
            ", "
        )
        return self.fail(f"'{value}' is not allowed here; give {allowed}", param, ctx)


def together(*options: Option, then: Callable[[dict[str, Any]], None] = lambda named: None) -> Option:
    """Several options as one decorator, in the order of the help.

    Args:
        options: decorators as `click.option` gives them.
        then: called with the keywords of the command before it, to change them in place.
    """

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def with_options(*args: Any, **named: Any) -> Any:
            then(named)
            return command(*args, **named)

        whole: Callable[..., Any] = with_options
        for option in reversed(options):
            whole = option(whole)
        return whole

    return add


def _all_that_fit(named: dict[str, Any]) -> None:
    if named["workers"] is None and named["scheduler"] is None:
        named["workers"] = 0  # as many as fit


worker_options = together(
    click.option(
        "--workers",
        type=Number(1),
        metavar="N",
        help="Parallel processes on this machine. [as many as cores and memory allow]",
    ),
    click.option("--scheduler", metavar="ADDRESS", help="Use the workers of a Dask cluster instead."),
    then=_all_that_fit,
)
"""Adds ``--workers`` and ``--scheduler``, as `geomoe3d.batch.run.register_pairs` takes them."""

scale_option = click.option(
    "--estimate-scale",
    is_flag=True,
    help="Estimate the scale too (1/1000 to 1000): the files may be in different units. Not with a first guess.",
)
"""Adds ``--estimate-scale``, for verbs with `configuration_options`."""

unit_option = click.option(
    "--unit",
    metavar="NAME",
    default="",
    help="Name of the files' unit of length, such as m; shown behind lengths, nothing is converted.",
)
"""Adds ``--unit``."""

cache_options = together(
    click.option(
        "--cache",
        metavar="FOLDER",
        help="Where features are kept for later. [the user's cache folder]",
    ),
    click.option("--no-cache", is_flag=True, help="Keep no features for later."),
    then=lambda named: named.update({"cache": ""} if named.pop("no_cache") else {}),
)
"""Adds ``--cache`` and ``--no-cache``; the command gets ``cache``, empty for none."""


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


def _assign_parts(named: dict[str, Any]) -> None:
    """Parts as assignments; that there are such parts is seen before anything is read. Raises ConfigError:
    there is none of a name."""
    given = [(option, key, named.pop(f"part_{option}")) for option, key, _ in _PARTS]
    given = [(option, key, value) for option, key, value in given if value is not None]
    scorers = named.pop("part_scorers")
    chosen = [f"{key}={value}" for _, key, value in given]
    if scorers:
        chosen.append(f"scoring.scorers=[{', '.join(scorers)}]")
    if chosen:  # nothing is loaded where none is named
        from geomoe3d.pipeline import REGISTRIES

        for option, name in [
            *((option, value) for option, _, value in given),
            *(("scorer", s) for s in scorers),
        ]:
            REGISTRIES[option].find(name)
    named["assignments"] = (*named["assignments"], *chosen)


method_part_options = together(
    *(click.option(f"--{name}", f"part_{name}", metavar="NAME", help=text) for name, _, text in _PARTS),
    click.option(
        "--scorer",
        "part_scorers",
        metavar="NAME",
        multiple=True,
        help="What scores the hypotheses: surfaces, network, or your own; repeatable. [surfaces, network]",
    ),
    then=_assign_parts,
)
"""Adds ``--descriptor`` and its like; the command finds what they come to at the end of its ``assignments``.

A part is a name or a class of the user's own, ``file.py:Class`` or ``module:Class``."""


def _configure(named: dict[str, Any]) -> None:
    from geomoe3d.config import load_config
    from geomoe3d.errors import ConfigError

    settings = [(key, named.pop(key)) for key in ("voxel_size", "seed")]
    settings.append(("scale", "estimate" if named.pop("estimate_scale", False) else None))
    chosen = [f"{key}={value}" for key, value in settings if value is not None]
    try:
        named["config"] = load_config(named.pop("config_file"), [*named.pop("assignments"), *chosen])
    except ConfigError as error:  # by the name under which it was given
        said = str(error)
        for key, value in settings:
            if value is not None:
                said = said.replace(f"configuration: '{key}'", f"--{key.replace('_', '-')}")
        raise type(error)(said) from None


configuration_options = together(
    click.option(
        "--voxel-size",
        metavar="LENGTH",
        help="Edge of the grid that points are thinned to, in the unit of the files. [chosen]",
    ),
    click.option("--seed", metavar="N", help="Random seed: the same seed, the same answers. [0]"),
    click.option(
        "--config",
        "config_file",
        metavar="FILE",
        help="File of settings (YAML), as `geomoe3d config` prints them.",
    ),
    click.option(
        "--set",
        "assignments",
        metavar="KEY=VALUE",
        multiple=True,
        help="One setting, such as decision.min_confidence=0.98; repeatable.",
    ),
    method_part_options,
    then=_configure,
)
"""Adds the options; the command gets what they come to as ``config``, a `RegistrationConfig`.

An option overrides ``--set``, which overrides the file."""
