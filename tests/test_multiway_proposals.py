"""Which pairs of many scans are worth registering."""

from __future__ import annotations

import numpy as np

from geomoe3d.multiway.proposals import propose_pairs, scan_similarity


def test_similar_scans_propose_each_other():
    rng = np.random.default_rng(0)
    kinds = [rng.normal(size=(40, 33)) for _ in range(3)]
    features = []
    for kind in kinds:
        for _ in range(3):
            f = kind[rng.integers(0, 40, 300)] + 0.2 * rng.normal(size=(300, 33))
            features.append((f / np.linalg.norm(f, axis=1, keepdims=True)).astype(np.float32))
    within = {(i, j) for j in range(9) for i in range(j) if i // 3 == j // 3}
    assert propose_pairs(features, 2) == within
    assert propose_pairs(features, 99) == {(i, j) for j in range(9) for i in range(j)}
    similarity = scan_similarity(features)
    assert np.allclose(similarity, similarity.T)
    assert np.array_equal(similarity, scan_similarity(features))
