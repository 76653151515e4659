"""From a registration that was asked to explain itself to what the displays take."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.visual.view import WEIGHT_THRESHOLD, RegistrationView

if TYPE_CHECKING:
    from geomoe3d.decision.explanation import Explanation


def explained_view(explanation: Explanation) -> RegistrationView:
    """The clouds, the answer and the correspondences of one registration, in file coordinates.

    Args:
        explanation: what `geomoe3d.registration.Registrar.explain` returned.
    """
    source, target, matched = explanation.source, explanation.target, explanation.correspondences
    weighed = explanation.weighed
    used = explanation.result.config
    filtered = used["filter"]["name"] != "none" or "network" in used["scoring"]["scorers"]
    groups = weighed.groups
    if groups is not None and len(np.unique(groups[weighed.weights > WEIGHT_THRESHOLD])) < 2:
        groups = None  # one colour for all would hide what agrees
    return RegistrationView(
        source.file_points,
        target.file_points,
        explanation.result,
        np.column_stack([matched.source + source.origin, matched.target + target.origin]),
        weights=weighed.weights if filtered else None,
        source_colors=source.colors,
        target_colors=target.colors,
        groups=groups,
        group_names=weighed.group_names,
    )
