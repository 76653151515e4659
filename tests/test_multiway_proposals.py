"""Which pairs of many scans are worth registering."""

from __future__ import annotations

import numpy as np

from geomoe3d.multiway.proposals import most_similar, scan_similarity


def test_the_most_similar_scans_are_those_of_the_same_place():
    rng = np.random.default_rng(0)
    kinds = [rng.normal(size=(40, 33)) for _ in range(3)]
    features = []
    for kind in kinds:
        for _ in range(3):
            f = kind[rng.integers(0, 40, 300)] + 0.2 * rng.normal(size=(300, 33))
            features.append((f / np.linalg.norm(f, axis=1, keepdims=True)).astype(np.float32))
    similarity = scan_similarity(features)
    for scan in range(9):
        of_its_kind = {k for k in range(9) if k // 3 == scan // 3} - {scan}
        assert set(most_similar(similarity, scan, range(9), 2)) == of_its_kind
        ranked = most_similar(similarity, scan, range(9), 99)
        assert sorted(ranked) == sorted(set(range(9)) - {scan})
        assert np.all(np.diff(similarity[scan, ranked]) <= 0)
    assert most_similar(np.zeros((4, 4)), 1, [3, 1, 2], 9) == [2, 3]
    assert np.allclose(similarity, similarity.T)
    assert np.array_equal(similarity, scan_similarity(features))
