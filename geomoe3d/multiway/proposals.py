"""Which pairs of many scans are worth registering: a cheap description of each scan as a whole.

VLAD over FPFH: every feature is given to its nearest of 64 words, and what it differs from that word by is
summed per word. Two scans of the same place see the same surfaces and get similar sums. The words are found
among the scans themselves. Cost: a few milliseconds per scan; docs/many.md says what share of the overlapping
pairs it finds.
Source: Jegou et al., CVPR 2010, with intra-normalisation and signed square root.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from geomoe3d.config import expert
from geomoe3d.runtime.threads import single_blas_thread
from geomoe3d.types import Float32Array, FloatArray, IntArray


def most_similar(similarity: FloatArray, scan: int, others: Iterable[int], count: int) -> list[int]:
    """Those of some scans that look most like one, the most similar first; of equals the first.

    Args:
        similarity: (K, K) of all scans.
        scan: number of the one.
        others: numbers of those to choose from; the scan itself is never chosen.
        count: how many to choose at most.
    """
    ranked = sorted((k for k in others if k != scan), key=lambda k: (-similarity[scan, k], k))
    return ranked[:count]


@single_blas_thread()
def scan_similarity(features: Sequence[Float32Array], *, seed: int = 0) -> FloatArray:
    """(K, K) cosine of the scans' descriptors."""
    rng = np.random.default_rng(seed)
    most = expert().many_pairs.word_sample
    sample = np.concatenate([f[rng.permutation(len(f))[:most]] for f in features]).astype(np.float64)
    words = _find_words(sample, rng)
    descriptors = np.stack([_describe(f.astype(np.float64), words) for f in features])
    similarity: FloatArray = descriptors @ descriptors.T
    return similarity


def _find_words(sample: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(W, 33) centres by k-means; a word that loses all its features begins anew at a random one."""
    words: FloatArray = sample[rng.permutation(len(sample))[: expert().many_pairs.words]].copy()
    for _ in range(expert().many_pairs.word_rounds):
        nearest = _nearest(sample, words)
        for k in range(len(words)):
            mine = nearest == k
            words[k] = sample[mine].mean(0) if mine.any() else sample[rng.integers(len(sample))]
    return words


def _describe(features: FloatArray, words: FloatArray) -> FloatArray:
    nearest = _nearest(features, words)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, features - words[nearest])
    sums /= np.linalg.norm(sums, axis=1, keepdims=True) + 1e-9
    rooted: FloatArray = np.sign(sums.ravel()) * np.sqrt(np.abs(sums.ravel()))
    rooted /= np.linalg.norm(rooted) + 1e-9
    return rooted


def _nearest(features: FloatArray, words: FloatArray) -> IntArray:
    nearest: IntArray = (features @ words.T - 0.5 * (words**2).sum(1)).argmax(1)
    return nearest
