"""Methods by name: ours on correspondences and clouds, other people's, and a user's own function.

``geomoe3d`` is the whole product with any configuration; ``geomoe`` (the shipped network on what consensus
proposes), ``geomoe-svd`` (weighted least squares on its weights alone), ``consensus`` and ``svd`` are parts
of it with a fixed one, to compare against. Peers are in `peers`, functions of the user in `adapter`. The
identity of ours holds that of every part and of the source that decides answers: a cache never mixes two versions.
"""

from __future__ import annotations

import difflib
import importlib.util
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from geomoe3d.config import RegistrationConfig, load_config
from geomoe3d.correspondence_registration import CorrespondenceRegistrar
from geomoe3d.errors import ConfigError, InputError
from geomoe3d.evaluation.adapter import AdaptedFunction
from geomoe3d.evaluation.peers import PEERS
from geomoe3d.evaluation.records import Answer, Method, MethodInput
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.scoring.network import NETWORK
from geomoe3d.types import BoolArray, FilterOutput, FloatArray

if TYPE_CHECKING:
    from geomoe3d.registration import Registrar

OURS: dict[str, tuple[str, ...]] = {
    "geomoe3d": (),
    "geomoe": ("scoring.scorers=[surfaces, network]",),
    "geomoe-svd": ("scoring.scorers=[surfaces, network]", "refinement.name=svd"),
    "consensus": ("scoring.scorers=[surfaces]",),
    "svd": ("scoring.scorers=[surfaces]", "estimator.name=svd"),
}
"""Our methods and what each sets; all but ``geomoe3d`` take correspondences alone and are fixed."""

TRAINED: dict[str, tuple[str, ...]] = {
    name: ("scoring.scorers=[surfaces]", f"filter.name={kind}", "estimator.name=svd")
    for name, kind in {
        "geomoe-plain": "geomoe",
        **{kind: kind for kind in ("pointcn", "oanet", "umatch", "dematch", "demo", "pointdsc")},
    }.items()
}
"""Networks that weigh correspondences, weighted least squares on their weights: ``filter.weights`` is needed."""

CONFIGURABLE = frozenset({"geomoe3d", *TRAINED})
"""Methods that take values of the configuration."""


def method_names() -> list[str]:
    """Every name that needs no weights, ours first; a user's function has no name here."""
    return [*OURS, *PEERS]


def make_method(spec: str, assignments: Sequence[str] = ()) -> Method:
    """The method of a name, or a user's function.

    Args:
        spec: one of `method_names` or `TRAINED`, ``path/to/file.py:function`` or ``package.module:function``.
        assignments: ``key=value`` of the configuration; those of `CONFIGURABLE` take any.

    Raises:
        InputError: an unknown name (the message gives the nearest one), a function that cannot be loaded, or
            assignments to a method that takes none.
        ConfigError: an unknown key or an invalid value.
        CheckpointError: trained weights are missing, broken or do not fit.
    """
    if assignments and spec not in CONFIGURABLE:
        raise InputError(
            f"'{assignments[0]}' sets a configuration value, but '{spec}' takes none; 'geomoe3d' and networks "
            f"with weights of yours ({', '.join(TRAINED)}) do"
        )
    if spec in OURS or spec in TRAINED:
        return OurMethod(spec, assignments)
    if spec in PEERS:
        return PEERS[spec]
    if ":" in spec:
        return AdaptedFunction(spec)
    known = [*method_names(), *TRAINED]
    close = difflib.get_close_matches(spec.lower(), known, n=1, cutoff=0.4)
    hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known)}."
    raise InputError(f"unknown method '{spec}'; {hint} A function of your own is written file.py:function")


class OurMethod:
    """The package's own pipeline or a part of it as a `Method`.

    Correspondences go through the configured filter and estimator, with the inlier threshold and voxel size
    of the input; a threshold that is assigned (``estimator.inlier_threshold``, in voxels) comes before that
    of the input. Clouds go through `Registrar.explain`, which chooses its own voxel size unless one is
    assigned. The seed is always that of the input.

    Args:
        name: one of `OURS` or `TRAINED`.
        assignments: ``key=value`` beside what the name sets.

    Raises:
        ConfigError: an unknown key, an invalid value, or ``seed``.
        CheckpointError: trained weights are missing, broken or do not fit.
    """

    def __init__(self, name: str, assignments: Sequence[str] = ()) -> None:
        self.name = name
        self.inputs = frozenset({"correspondences", "clouds"} if name == "geomoe3d" else {"correspondences"})
        settings = OURS[name] if name in OURS else TRAINED[name]
        keys = {assignment.partition("=")[0].strip() for assignment in assignments}
        if name in TRAINED and "filter.weights" not in keys:
            raise InputError(f"'{name}' needs trained weights; give --set filter.weights=FILE")
        if "seed" in keys:
            raise ConfigError("'seed' is that of the evaluation for all methods; leave it out of the values")
        self.config: RegistrationConfig = resolved(load_config(None, [*settings, *assignments]))
        self._own_threshold = "estimator.inlier_threshold" in keys
        self._registrar: Registrar | None = None
        self._solver: CorrespondenceRegistrar | None = None
        if self.absent() is None:
            self._solver = CorrespondenceRegistrar(self.config)
            chosen = self._solver.pipeline.filter
            if chosen is not None and chosen.needs:
                self.inputs -= {"correspondences"}  # bare coordinates lack what the filter needs

    def identity(self) -> dict[str, Any]:
        """Configuration, and the identity of the pipeline: code, parts with their weights, versions."""
        config = self.config.model_dump(mode="json")
        config.pop("seed")
        line = Pipeline(self.config) if self._solver is None else self._solver.pipeline
        return {"config": config, "own_threshold": self._own_threshold, **line.identity()}

    def absent(self) -> str | None:
        """Whether a library that the network needs is missing, and how to install it."""
        weighs = self.config.filter.weights is not None
        needed = {"torch": weighs, "safetensors": weighs or NETWORK in self.config.scoring.scorers}
        for module in (name for name, wanted in needed.items() if wanted):
            if importlib.util.find_spec(module) is None:
                return f"the network needs {module}, which is not installed: pip install {module}"
        return None

    def __call__(self, given: MethodInput) -> Answer:
        """Register one pair; see `Method`."""
        if given.correspondences is not None and "correspondences" in self.inputs:
            return self._from_correspondences(given.correspondences, given)
        if given.source is not None and given.target is not None and "clouds" in self.inputs:
            return self._from_clouds(given.source, given.target, given.seed)
        raise InputError(f"{given.pair}: '{self.name}' takes {' or '.join(sorted(self.inputs))}")

    def _from_correspondences(self, rows: FloatArray, given: MethodInput) -> Answer:
        """Filter and estimator on rows (N, 6), each half recentred."""
        if self._solver is None:
            raise InputError(f"{given.pair}: {self.absent()}")
        if len(rows) < 3:
            return Answer(None)
        found = self._solver(
            rows,
            voxel_size=given.voxel_size,
            inlier_threshold=None if self._own_threshold else given.inlier_threshold,
            seed=given.seed,
        )
        return Answer(
            found.T_target_source if found.found else None,
            hypotheses=found.others,
            weights=self._weights(found.weighed),
            inliers=_declared(found.weighed),
            stages=_stages(found.seconds),
        )

    def _from_clouds(self, source: FloatArray, target: FloatArray, seed: int) -> Answer:
        """The whole pipeline on points (n, 3) and (m, 3)."""
        explained = self._registrar_for(seed).explain(source, target)
        result = explained.result
        T = result.T_target_source
        shown = len(explained.correspondences) > 0
        shift = np.concatenate([explained.source.origin, explained.target.origin])
        return Answer(
            T if np.isfinite(T).all() else None,
            confidence=result.confidence,
            status=result.status,
            hypotheses=() if result.alternative is None else (result.alternative.T_target_source,),
            correspondences=explained.correspondences.points + shift,
            weights=self._weights(explained.weighed) if shown else None,
            inliers=_declared(explained.weighed) if shown else None,
            stages=_stages(result.seconds),
        )

    def _registrar_for(self, seed: int) -> Registrar:
        from geomoe3d.registration import Registrar

        if self._registrar is None or self._registrar.config.seed != seed:
            self._registrar = Registrar(self.config.model_copy(update={"seed": seed}))
        return self._registrar

    def _weights(self, weighed: FilterOutput) -> FloatArray | None:
        """None where nothing was weighed: ones say nothing."""
        anything = self.config.filter.name != "none" or NETWORK in self.config.scoring.scorers
        return weighed.weights if anything else None


def _declared(weighed: FilterOutput) -> BoolArray | None:
    """(N,) the filter's own classification: a positive logit; None for filters without logits."""
    return None if weighed.logits is None else np.asarray(weighed.logits > 0)


def _stages(seconds: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in seconds.items() if name != "total"}
