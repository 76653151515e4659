"""Decisions: none where no transform was found, and residuals after the one that was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from surface_pairs import motion

from geomoe3d.decision.answer import Decision
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.types import Correspondences, Hypothesis


def test_nothing_found_holds_no_transform() -> None:
    nothing = Decision.failed("no motion")
    assert np.isnan(nothing.T_target_source).all()
    assert nothing.judgement.status == "failed"
    assert nothing.judgement.confidence == 0
    assert nothing.judgement.reasons == ("no motion",)
    residuals = nothing.residuals(Correspondences(np.zeros((4, 6))))
    assert (residuals == np.inf).all()
    assert residuals.shape == (4,)


def test_residuals_are_distances_after_the_motion() -> None:
    T, rng = motion(5), np.random.default_rng(5)
    source, gaps = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    rows = Correspondences(np.hstack([source, transform_points(T, source) + gaps]))
    found = replace(Decision.failed(""), answer=Hypothesis(T))
    np.testing.assert_allclose(found.residuals(rows), np.linalg.norm(gaps, axis=1))
    exchanged = Correspondences(rows.points[:, [3, 4, 5, 0, 1, 2]])
    back = replace(found, answer=Hypothesis(inverse(T)))
    np.testing.assert_allclose(back.residuals(exchanged), np.linalg.norm(gaps, axis=1))
