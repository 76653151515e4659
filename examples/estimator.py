"""An estimator of your own: triples of correspondences at random, the best few kept.

geomoe3d register source.ply target.ply --estimator examples/estimator.py:Triples
geomoe3d register source.ply target.ply --estimator examples/estimator.py:Triples --set estimator.options.draws=5000
"""

import numpy as np

from geomoe3d.estimators.base import Estimator, check_correspondences
from geomoe3d.geometry.rigid_fit import fit_rigid
from geomoe3d.geometry.se3 import make_transform, residuals
from geomoe3d.types import Hypothesis


class Triples(Estimator):
    """Least squares on random triples that keep their lengths, ranked by their inliers.

    Args:
        draws: triples tried.
        kept: hypotheses returned at most.
    """

    def __init__(self, draws=20000, kept=20):
        self.draws, self.kept = int(draws), int(kept)

    def __call__(self, correspondences, weights=None, *, inlier_threshold, seed=0):
        rows, weights = check_correspondences(correspondences, weights, inlier_threshold)
        rows = rows[weights > 0]
        if len(rows) < 3:
            return []
        triples = np.random.default_rng(seed).integers(0, len(rows), (self.draws, 3))
        edges = rows[triples] - rows[np.roll(triples, 1, axis=1)]
        lengths = np.linalg.norm(edges.reshape(self.draws, 3, 2, 3), axis=3)
        alike = np.abs(lengths[..., 0] - lengths[..., 1]).max(1) < inlier_threshold
        wide = lengths.min(axis=(1, 2)) > 5 * inlier_threshold
        found = []
        for triple in triples[alike & wide]:
            T = make_transform(*fit_rigid(rows[triple, :3], rows[triple, 3:], np.ones(3)))
            inliers = residuals(T, rows[:, :3], rows[:, 3:]) < inlier_threshold
            found.append(Hypothesis(T, float(inliers.sum()), int(inliers.sum())))
        return sorted(found, key=lambda hypothesis: -hypothesis.proposal_score)[: self.kept]
