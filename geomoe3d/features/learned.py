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
_TOGETHER, _NEAR = 1024, 256
"""Points that one thread works on at a time; of these, as many as stay near a core with what their neighbours hold."""


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

        def around(at: Level, of: Level) -> IntArray:
            return np.ascontiguousarray(nearest(at, of, NUM_NEIGHBORS)[1].T)

        own = [self._mlp(f"embed.{k}", self._given(level)) for k, level in ((1, middle), (2, coarse))]
        held = self._look("middle_middle", middle, middle, around(middle, middle), own[0], own[0])
        wide = self._look("coarse_middle", coarse, middle, around(coarse, middle), own[1], held)
        wide = self._look("coarse_coarse", coarse, coarse, around(coarse, coarse), wide, wide)
        # Of all points at once, since these searches share their work among threads by themselves.
        in_middle, in_coarse = around(fine, middle), around(fine, coarse)

        def part(start: int) -> Float32Array:
            chunk = slice(start, start + _TOGETHER)
            some = fine.take(chunk)
            own = self._mlp("embed.0", self._given(some))
            near = self._look("fine_middle", some, middle, in_middle[:, chunk], own, held)
            far = self._look("fine_coarse", some, coarse, in_coarse[:, chunk], near, wide)
            found = self._mlp("head", np.hstack([own, near, far]))
            found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), np.float32(1e-12))
            return found

        return np.concatenate(each(part, range(0, len(rows), _TOGETHER)))

    def _given(self, level: Level) -> Float32Array:
        """What a point begins with: the cloud's own FPFH there, on coarser levels also that of the level."""
        of_cloud = self._levels[0].features[level.rows]
        return of_cloud if level.edge == FACTORS[0] else np.hstack([of_cloud, level.features])

    def _look(
        self, name: str, at: Level, of: Level, rows: IntArray, held: Float32Array, of_held: Float32Array
    ) -> Float32Array:
        """What the points of ``at`` hold after a look at their neighbours among ``of``, ``rows`` (k, m)."""
        there = self._linear(f"{name}.there", of_held)

        def part(start: int) -> Float32Array:
            chunk = slice(start, start + _TOGETHER)
            lie = relations(at.take(chunk), of, rows[:, chunk])
            return self._looked(name, lie, rows[:, chunk], held[chunk], there)

        return np.concatenate(each(part, range(0, len(at), _TOGETHER)))

    def _looked(
        self, name: str, lie: Float32Array, rows: IntArray, held: Float32Array, there: Float32Array
    ) -> Float32Array:
        """`_look` of some points: how their neighbours lie (k, m, 8), what they hold, what all others show."""
        from scipy.linalg.blas import sgemm

        here = self._linear(f"{name}.here", held) + self._tensors[f"{name}.lie.bias"]
        weights = self._tensors[f"{name}.lie.weight"]
        largest, mean = np.empty_like(here), np.empty_like(here)
        for start in range(0, len(held), _NEAR):
            near = slice(start, start + _NEAR)
            # Neighbours come first: the largest and the mean over them are then quick to take.
            seen = there.take(rows[:, near], axis=0)
            lies, sums = (x.reshape(-1, x.shape[2]) for x in (lie[:, near], seen))
            # Added in the place of what others show. BLAS counts the other way round.
            added = sgemm(1.0, weights.T, lies.T, beta=1.0, c=sums.T, overwrite_c=1, trans_a=1)
            seen = added.T.reshape(seen.shape)
            # Of x + h what is positive is the larger one of x and -h, plus h.
            np.maximum(seen, -here[near], out=seen)
            seen.max(0, out=largest[near])
            np.add.reduce(seen, axis=0, out=mean[near])
        mean *= np.float32(1 / len(rows))
        largest += here
        mean += here
        return held + self._mlp(f"{name}.out", np.hstack([largest, mean, held]), normalised=True)

    def _mlp(self, name: str, x: Float32Array, *, normalised: bool = False) -> Float32Array:
        """Linear, layer norm if ``normalised``, what is positive, linear."""
        x = self._linear(f"{name}.0", x)
        if normalised:
            x -= x.mean(1, keepdims=True)
            # As torch's layer norm.
            x /= np.sqrt(np.mean(x * x, axis=1, keepdims=True) + np.float32(1e-5))
            x *= self._tensors[f"{name}.1.weight"]
            x += self._tensors[f"{name}.1.bias"]
        return self._linear(f"{name}.3" if normalised else f"{name}.2", np.maximum(x, 0, out=x))

    def _linear(self, name: str, x: Float32Array) -> Float32Array:
        y: Float32Array = x @ self._tensors[f"{name}.weight"].T
        bias = self._tensors.get(f"{name}.bias")
        if bias is not None:
            y += bias
        return y


def load_tensors(path: Path) -> dict[str, Float32Array]:
    """The tensors of a weight file by name, float32. Raises CheckpointError: no such file, or it is none of
    this network's."""
    return read_tensors(path, "the learned descriptor", "head.2.weight", (LEARNED, None))
