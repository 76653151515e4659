"""Predictions in a file come back as they were made."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fake_methods import Fake, load_like
from posed_scans import motion

from geomoe3d.evaluation.predict import predict_one
from geomoe3d.evaluation.predictions import decode, encode
from geomoe3d.evaluation.records import Answer, MethodInput
from geomoe3d.geometry.se3 import transform_points


def test_predictions_survive_the_store() -> None:
    rng = np.random.default_rng(0)
    rows = np.hstack([rng.normal(size=(1003, 3)), rng.normal(size=(1003, 3))])
    T = motion(3)
    rows[:500, 3:] = transform_points(T, rows[:500, :3])
    weights = rng.uniform(size=1003)
    answer = Answer(T, 0.7, "ok", (motion(1), motion(2)), None, weights, weights > 0.5, {"solve": 0.25})
    pair = load_like(T)
    prediction = predict_one(Fake(lambda given: answer), pair, MethodInput("a/0-1", correspondences=rows))
    found = decode(json.loads(json.dumps(encode(prediction), allow_nan=False)))
    assert np.array_equal(found.T_target_source, T)
    assert found.labels.true[:500].all()
    assert not found.labels.true[500:].all()
    for name in ("true", "kept", "verified"):
        assert np.array_equal(getattr(found.labels, name), getattr(prediction.labels, name))
    assert np.array_equal(found.labels.kept, weights > 0.5)
    assert np.abs(found.weights - weights).max() < 1e-3
    assert [np.array_equal(a, b) for a, b in zip(found.hypotheses, answer.hypotheses, strict=True)] == [
        True
    ] * 2
    assert (found.pair, found.confidence, found.status) == ("a/0-1", 0.7, "ok")
    assert found.stages == {"solve": 0.25}
    assert found.seconds == prediction.seconds > 0
    assert found.error is None


@pytest.mark.parametrize("T", [None, np.full((4, 4), np.nan)])
def test_no_motion_is_stored_as_none(T: np.ndarray | None) -> None:
    given = MethodInput("a/0-1", correspondences=np.ones((5, 6)))
    prediction = predict_one(Fake(lambda _: Answer(T)), load_like(np.eye(4)), given)
    assert prediction.T_target_source is None
    assert prediction.labels.true.all()
    assert not prediction.labels.verified.any()
    assert decode(encode(prediction)).T_target_source is None
