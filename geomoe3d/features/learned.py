"""The learned descriptor: FPFH of three reaches, and a small network that looks at how neighbours lie around
a point.

Here it runs in numpy, without torch; `geomoe3d.training.descriptor` holds the same network to be trained. A
level is a grid of `pyramid`. Each point of a level begins with its FPFH; then the middle level looks at its
own neighbours, the coarse one at the middle one's and its own, and every point of the cloud at both. To look
at neighbours (`_look`) is to form, for each of the 16 nearest points, a vector from what both hold and how
they lie (`relations`), and to keep the largest and the mean of these. Lengths are in voxels. All of it is
the same however a cloud lies; only the grids, and so the points of the levels, follow the cloud's axes.

About twice the time of FPFH; memory of a few MB for each thread besides 300 numbers per point.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import ClassVar

import numpy as np

from geomoe3d.config import expert
from geomoe3d.features.base import Descriptor, descriptor
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.features.pyramid import FACTORS, Level, nearest, pyramid, relations
from geomoe3d.runtime.tensors import read_tensors
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import Float32Array, IntArray, PreparedCloud

NUM_NEIGHBORS = 16
LEARNED = 32
DIMENSION = LEARNED + 33
WEIGHTS = Path(__file__).parent / "weights" / "learned.safetensors"


@descriptor("learned")
class LearnedDescriptor(Descriptor):
    """32 numbers learnt by contrast on generated rooms, scans and bodies and one recorded lounge, joined with
    the FPFH that they begin with, which by itself still finds what they do not.

    Args:
        weights: a .safetensors file that `geomoe3d.training.descriptor` wrote; None takes what ships.

    Raises:
        CheckpointError: the file is missing, damaged, or holds another network.
    """

    dimension: ClassVar[int] = DIMENSION  # type: ignore[misc]

    def __init__(self, weights: str | None = None) -> None:
        self.weights = weights
        path = WEIGHTS if weights is None else Path(weights)
        self._tensors = load_tensors(path)
        self.sha256 = hashlib.sha256(path.read_bytes()).hexdigest()  # part of what identifies the features

    def __call__(self, cloud: PreparedCloud) -> Float32Array:
        """See `Descriptor`."""
        return self._of(pyramid(cloud))

    def again(self, cloud: PreparedCloud, before: Descriptor) -> Float32Array:
        """See `Descriptor`; FPFH that is there is not computed again."""
        return self._of(pyramid(cloud, cloud.features if before == FpfhDescriptor() else None))

    def _of(self, levels: tuple[Level, ...]) -> Float32Array:
        return self.at(levels, np.arange(len(levels[0])))

    def at(self, levels: tuple[Level, ...], rows: IntArray) -> Float32Array:
        """Features (m, 65) of some points of a cloud, the cheaper the fewer.

        Args:
            levels: of the cloud, by `pyramid`.
            rows: (m,) of the finest level.
        """
        given = levels[0].features[rows]
        if not levels[0].features.any():  # isolated points have nothing to go by
            return np.zeros((len(rows), DIMENSION), dtype=np.float32)
        with single_blas_thread():
            learned = _Network(self._tensors, levels).features(rows)
        share = expert().features.fpfh_share
        shares = np.sqrt(np.array([1 - share, share], dtype=np.float32))
        return np.hstack([shares[0] * learned, shares[1] * given])


class _Network:
    """One evaluation: the tensors by name, and the levels they are applied to."""

    def __init__(self, tensors: dict[str, Float32Array], levels: tuple[Level, ...]) -> None:
        self._tensors, self._levels = tensors, levels

    def features(self, rows: IntArray) -> Float32Array:
        """(m, 32) unit features of some points of the finest level."""
        whole, middle, coarse = self._levels
        fine = whole.take(rows)
        own = [self._mlp(f"embed.{k}", self._given(level)) for k, level in enumerate((fine, middle, coarse))]
        held = self._look("middle_middle", middle, middle, own[1], own[1])
        wide = self._look("coarse_middle", coarse, middle, own[2], held)
        wide = self._look("coarse_coarse", coarse, coarse, wide, wide)
        near = self._look("fine_middle", fine, middle, own[0], held)
        far = self._look("fine_coarse", fine, coarse, near, wide)
        found = self._mlp("head", np.hstack([own[0], near, far]))
        unit: Float32Array = found / np.maximum(
            np.linalg.norm(found, axis=1, keepdims=True), np.float32(1e-12)
        )
        return unit

    def _given(self, level: Level) -> Float32Array:
        """What a point begins with: the cloud's own FPFH there, on coarser levels also that of the level."""
        of_cloud = self._levels[0].features[level.rows]
        return of_cloud if level.edge == FACTORS[0] else np.hstack([of_cloud, level.features])

    def _look(
        self, name: str, at: Level, of: Level, held: Float32Array, of_held: Float32Array
    ) -> Float32Array:
        """What the points of ``at`` hold after a look at their neighbours among ``of``."""
        _, rows = nearest(at, of, NUM_NEIGHBORS)
        here = self._linear(f"{name}.here", held)
        there = self._linear(f"{name}.there", of_held)

        size = 256  # points at a time: what they and their neighbours hold stays near a core

        def part(start: int) -> Float32Array:
            chunk = slice(start, start + size)
            # Neighbours come first: the largest and the mean over them are then quick to take.
            lie = relations(at.take(chunk), of, rows[chunk]).swapaxes(0, 1)
            seen = self._linear(f"{name}.lie", np.ascontiguousarray(lie))
            seen += there[rows[chunk].T]
            seen += here[chunk]
            np.maximum(seen, 0, out=seen)
            return np.hstack([seen.max(0), seen.mean(0), held[chunk]])

        joined = np.concatenate(each(part, range(0, len(at), size)))
        return held + self._mlp(f"{name}.out", joined, normalised=True)

    def _mlp(self, name: str, x: Float32Array, *, normalised: bool = False) -> Float32Array:
        """Linear, layer norm if ``normalised``, what is positive, linear."""
        x = self._linear(f"{name}.0", x)
        if normalised:
            x -= x.mean(1, keepdims=True)
            # As torch's layer norm.
            x /= np.sqrt(np.mean(x * x, axis=1, keepdims=True) + np.float32(1e-5))
            x = x * self._tensors[f"{name}.1.weight"] + self._tensors[f"{name}.1.bias"]
        return self._linear(f"{name}.3" if normalised else f"{name}.2", np.maximum(x, 0))

    def _linear(self, name: str, x: Float32Array) -> Float32Array:
        y: Float32Array = x @ self._tensors[f"{name}.weight"].T
        bias = self._tensors.get(f"{name}.bias")
        return y if bias is None else y + bias


def load_tensors(path: Path) -> dict[str, Float32Array]:
    """The tensors of a weight file by name, float32. Raises CheckpointError: no such file, or it is none of
    this network's."""
    return read_tensors(path, "the learned descriptor", "head.2.weight", (LEARNED, None))
