"""The one form of a filter, and the choice by name.

A filter gives every putative correspondence a weight and drops nothing. Place:
weigh, between match and solve. New filters join by a line in `_FACTORIES`; the pipeline does not change.
"""

from __future__ import annotations

import difflib
import importlib.util
from collections.abc import Callable
from typing import Protocol

import numpy as np

from geomoe3d.config import EstimatorConfig, FilterConfig, RegistrationConfig
from geomoe3d.errors import ConfigError, DependencyError
from geomoe3d.networks.weight_files import DEFAULT_WEIGHTS, packaged_names
from geomoe3d.types import Correspondences
from geomoe3d.types import FilterOutput as FilterOutput  # part of the form, offered here too


class Filter(Protocol):
    """Anything that weighs correspondences."""

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """Weigh correspondences.

        Args:
            correspondences: N rows in local coordinates; the per-row attributes may be None.
            voxel_size: the grid the points came from, cloud units: what the scale of noise is.
            seed: decides every random choice.

        Returns:
            One weight per correspondence; for N = 0 an empty array.
        """
        ...


class NoFilter:
    """All correspondences weigh the same."""

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """See `Filter`: all ones."""
        return FilterOutput(np.ones(len(correspondences)))


def _none(weights: str | None, estimator: EstimatorConfig) -> Filter:
    return NoFilter()


def _spectral(weights: str | None, estimator: EstimatorConfig) -> Filter:
    from geomoe3d.filters.spectral import SpectralFilter

    return SpectralFilter()


def _geomoe(weights: str | None, estimator: EstimatorConfig) -> Filter:
    try:
        from geomoe3d.filters.network import geomoe_filter
    except ImportError as error:
        raise DependencyError(
            f"the filter 'geomoe' needs PyTorch and safetensors ({error}); `geomoe3d doctor` gives the "
            "command that installs them, or use --filter none"
        ) from error
    return geomoe_filter(weights, estimator)


_FACTORIES: dict[str, Callable[[str | None, EstimatorConfig], Filter]] = {
    "none": _none,
    "spectral": _spectral,
    "geomoe": _geomoe,
}


def filter_names() -> list[str]:
    """Names that `make_filter` knows."""
    return list(_FACTORIES)


def resolve_filter(config: FilterConfig) -> FilterConfig:
    """What ``auto`` means on this machine; any other name as it is.

    The network is taken where weights are given, and where its libraries are installed and weights ship with
    the package.
    """
    if config.name != "auto":
        return config
    installed = all(importlib.util.find_spec(name) is not None for name in ("torch", "safetensors"))
    usable = config.weights is not None or (installed and DEFAULT_WEIGHTS in packaged_names())
    return config.model_copy(update={"name": "geomoe" if usable else "none"})


def resolved(config: RegistrationConfig | None) -> RegistrationConfig:
    """The configuration, None for the defaults, with ``auto`` replaced by what it means on this machine.

    Raises:
        ConfigError: something else than a configuration.
    """
    config = RegistrationConfig() if config is None else config
    if not isinstance(config, RegistrationConfig):
        raise ConfigError(
            f"config is a {type(config).__name__}, expected a RegistrationConfig; load_config(path, "
            f"['key=value', ...]) makes one"
        )
    return config.model_copy(update={"filter": resolve_filter(config.filter)})


def make_filter(name: str, weights: str | None = None, estimator: EstimatorConfig | None = None) -> Filter:
    """The filter of a given name.

    Args:
        name: one of `filter_names`; ``auto`` is resolved by `resolve_filter` before.
        weights: file or name of trained weights, for filters that have any; None takes the shipped ones.
        estimator: what proposes motions to filters that judge some; None takes the defaults.

    Raises:
        ConfigError: no filter has this name; the message gives the nearest one.
        CheckpointError: the weights are missing, broken or do not fit.
        DependencyError: a library that the filter needs is not installed.
    """
    if name in _FACTORIES:
        return _FACTORIES[name](weights, estimator or EstimatorConfig())
    close = difflib.get_close_matches(name, _FACTORIES, n=1, cutoff=0.4)
    hint = f"did you mean '{close[0]}'?" if close else "known: " + ", ".join(_FACTORIES)
    raise ConfigError(f"unknown filter '{name}'; {hint}")
