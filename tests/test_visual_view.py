"""What is shown is checked, and the kept correspondences follow the transform or the weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from registration_views import room_view, without_transform

from geomoe3d.errors import InputError


def test_residuals_and_kept_follow_the_transform_or_the_weights():
    view = room_view()
    expected = np.linalg.norm(
        view.result.apply(view.correspondences[:, :3]) - view.correspondences[:, 3:], axis=1
    )
    np.testing.assert_allclose(view.residuals(), expected)
    np.testing.assert_array_equal(view.kept(), expected <= 0.1)
    assert view.kept()[:200].mean() > 0.95
    assert view.kept()[200:].mean() < 0.1
    weights = np.linspace(0, 1, 300)
    np.testing.assert_array_equal(replace(view, weights=weights).kept(), view.kept())
    lost = without_transform(view)
    filtered = replace(lost, weights=weights)  # nothing but the filter speaks then
    np.testing.assert_array_equal(filtered.kept(), weights > 0.5)
    np.testing.assert_array_equal(replace(filtered, weight_threshold=0.0).kept(), weights > 0)
    assert np.isnan(lost.residuals()).all()
    assert not lost.kept().any()
    assert not lost.has_transform


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"source_points": np.zeros((5, 2))}, r"source_points.*\(N, 3\).*\(5, 2\)"),
        ({"correspondences": np.zeros((5, 3))}, r"correspondences.*\(N, 6\)"),
        ({"weights": np.zeros(299)}, r"weights.*\(300,\).*\(299,\)"),
        ({"weights": np.full(300, 1.5)}, r"weights.*\[0, 1\].*1.5"),
        ({"target_colors": np.full((7, 3), 0.5)}, "target_colors"),
        ({"groups": np.zeros(300)}, "groups.*integers"),
        ({"groups": np.full(300, -1)}, "groups.*negative"),
    ],
)
def test_parts_that_do_not_fit_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        room_view(**changes)
