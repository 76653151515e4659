"""From a registration that was asked to explain itself to what the displays take."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.visual.view import RegistrationView

if TYPE_CHECKING:
    from geomoe3d.registration import Explanation


def explained_view(explanation: Explanation) -> RegistrationView:
    """The clouds, the answer and the correspondences of one registration, in file coordinates.

    Args:
        explanation: what `geomoe3d.registration.Registrar.explain` returned.
    """
    source, target, matched = explanation.source, explanation.target, explanation.correspondences
    filtered = explanation.result.config["filter"]["name"] != "none"  # which weighs everything alike
    return RegistrationView(
        source.file_points,
        target.file_points,
        explanation.result,
        np.column_stack([matched.source + source.origin, matched.target + target.origin]),
        weights=explanation.weighed.weights if filtered else None,
        source_colors=source.colors,
        target_colors=target.colors,
        groups=explanation.weighed.groups,
        group_names=explanation.weighed.group_names,
    )
