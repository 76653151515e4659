"""A method of an evaluation that answers as a test decides."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomoe3d.evaluation.records import Answer, MethodInput


class Fake:
    """A method whose answers and identity a test decides; counts what it was given."""

    name = "fake"
    inputs = frozenset({"correspondences", "clouds"})

    def __init__(self, answer=None, identity=None, absent=None) -> None:
        self.seen: list[MethodInput] = []
        self._answer = answer or (lambda given: Answer(np.eye(4)))
        self._identity, self._absent = identity or {"version": 1}, absent

    def identity(self):
        return self._identity

    def absent(self):
        return self._absent

    def __call__(self, given: MethodInput) -> Answer:
        self.seen.append(given)
        return self._answer(given)


def load_like(T: np.ndarray):
    from geomoe3d.evaluation.records import EvaluationPair

    return EvaluationPair("a/0-1", "3DMatch", "a", Path("a"), Path("b"), T)
