"""The same GeoMoE for inference, in numpy: norms and projections folded, no torch to be imported.

In evaluation batch norms are affine maps and disappear into their neighbours. In both attentions between
N correspondences and M sub-fields the N side is never projected: queries, keys and values of the M side are
multiplied into the weights first, so per layer only six products run over all correspondences. Constants
that a softmax cancels are dropped. Logits agree with `GeoMoE` to 1e-5; tests hold it to that. Linear in N.
Several motions at a time hold the interpreter less, so that threads stand in each other's way less.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geomoe3d.networks.aligned import CHANNELS, PRIOR_KERNEL
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.config import FIXED
from geomoe3d.networks.folded_blocks import (
    FoldedExperts,
    FoldedRectifier,
    FoldedUpdate,
    NormRelu,
    Product,
    Tensors,
    TwoProducts,
    relu,
    single,
    softmax,
)
from geomoe3d.types import Float32Array, FloatArray, IntArray

if TYPE_CHECKING:
    from geomoe3d.networks.geomoe import GeoMoE


class FoldedOutput(NamedTuple):
    """Logits of every layer and what the last layer did.

    Attributes:
        logits: (L, N) float32.
        sub_field: (N,) sub-field from which each correspondence is mostly rebuilt.
        expert: (M,) main expert of each sub-field, or None without experts.
        verdict: logit that the motion is right, or None for a network that is given none.
    """

    logits: Float32Array
    sub_field: IntArray
    expert: IntArray | None
    verdict: float | None = None


class FoldedGeoMoE:
    """Inference with a trained network, one pair at a time.

    Args:
        config: of a GeoMoE.
        tensors: its parameters and buffers by name; copied.

    Raises:
        CheckpointError: they do not fit the configuration.
    """

    def __init__(self, config: NetworkConfig, tensors: Mapping[str, NDArray[Any]]) -> None:
        self.config = config
        given = Tensors(tensors)
        self._initialise = _Initialise(given.at("initialise"), config)
        self._layers = [_Layer(given.at(f"layers.{k}"), config) for k in range(config.num_layers)]
        self._verdict = _Verdict(given.at("verdict"), config) if config.judges_motions else None
        given.check_all_used()

    @classmethod
    def of(cls, model: GeoMoE) -> FoldedGeoMoE:
        """With the weights that a network has now."""
        return cls(model.config, {name: x.detach().cpu().numpy() for name, x in model.state_dict().items()})

    def __call__(
        self, coordinates: Float32Array, channels: Float32Array | None, neighbors: IntArray
    ) -> FoldedOutput:
        """Weigh one pair.

        Args:
            coordinates: (N, 2d) float32 as `geomoe3d.networks.inputs` gives them.
            channels: (N, C) float32 or None.
            neighbors: (N, K) int64.
        """
        return self.under_motions(coordinates, None if channels is None else channels[None], neighbors)[0]

    def under_motions(
        self, coordinates: Float32Array, channels: Float32Array | None, neighbors: IntArray
    ) -> list[FoldedOutput]:
        """Weigh one pair under each of B motions, whose channels are (B, N, C); the rest as for one."""
        index = neighbors.T.ravel()
        field = self._initialise(coordinates, channels)
        together = logits = None
        if self._verdict is not None:
            assert channels is not None
            together = channels[..., CHANNELS.index("residual")]
            logits = together - np.float32(PRIOR_KERNEL)
        of_layers = []
        for layer in self._layers:
            field, logits, attention, expert = layer(field, logits, index)
            of_layers.append(logits)
        sub_field = attention.sum(axis=1).argmax(axis=1)
        verdict = None
        if self._verdict is not None and channels is not None and together is not None:
            verdict = self._verdict(channels, field, together)
        return [
            FoldedOutput(
                np.stack([logits[k] for logits in of_layers]),
                sub_field[k],
                None if expert is None else expert[k],
                None if verdict is None else float(verdict[k]),
            )
            for k in range(len(field))
        ]


class _Initialise:
    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        self.motion_form, width = config.motion_form, config.width
        self.embedding = Product(*tensors.affine("embedding", config.input_width, width))
        block = tensors.at("block")
        self.norms = [
            NormRelu(block.scale_shift("norm1", width), context=config.embedding_norm),
            NormRelu(block.scale_shift("norm2", width), context=True),
        ]
        self.linears = [Product(*block.affine(name, width, width)) for name in ("linear1", "linear2")]

    def __call__(self, coordinates: Float32Array, channels: Float32Array | None) -> Float32Array:
        """(N, 2d) and (B, N, C) to the field (B, width, N)."""
        num = 1 if channels is None else len(channels)
        half = coordinates.shape[1] // 2
        inputs = []
        if self.motion_form != "none":
            first, second = coordinates[:, :half], coordinates[:, half:]
            motion = np.hstack([first, second - first if self.motion_form == "difference" else second])
            inputs.append(np.broadcast_to(motion, (num, *motion.shape)))
        if channels is not None:
            inputs.append(channels)
        x = self.embedding(np.concatenate(inputs, axis=2).swapaxes(1, 2))
        h = x
        for norm, linear in zip(self.norms, self.linears, strict=True):
            h = linear(norm(h))
        x += h
        return x


class _Layer:
    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        width = config.width
        self.context = _Context(tensors.at("context"), config) if config.local_context else None
        pool = tensors.at("decompose.pool")
        self.pool_norm = NormRelu(pool.scale_shift("norm", width), context=True)
        # The bias cancels in the softmax over the points.
        self.pool = Product(pool.affine("linear", width, config.num_sub_fields)[0])
        self.experts = FoldedExperts(tensors.at("decompose.experts"), config)
        self.gather = _Gather(tensors.at("decompose.gather"), config)
        self.rectify = FoldedRectifier(tensors.at("rectify"), config)
        self.rebuild = _Rebuild(tensors.at("reconstruct"), config)
        self.predict_norm = NormRelu(tensors.scale_shift("predict.norm", width), context=False)
        self.predict = Product(*tensors.affine("predict.linear", width, 1))

    def __call__(
        self, field: Float32Array, logits: Float32Array | None, index: IntArray
    ) -> tuple[Float32Array, Float32Array, Float32Array, IntArray | None]:
        if self.context is not None:
            field = self.context(field, index)
        weights = softmax(self.pool(self.pool_norm(field)), 2)
        z, _ = self.experts(np.matmul(field, weights.swapaxes(1, 2)))
        z, routing = self.rectify(self.gather(z, field, logits))
        field, attention = self.rebuild(field, z)
        return field, self.predict(self.predict_norm(field))[:, 0], attention, routing


class _Context:
    """Local context on (B, d', K, N): channels are mixed as (d', K N), neighbours as d' products (K, N)."""

    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        self.residual = config.context_residual
        width, few, near = config.width, config.context_width, config.num_neighbors
        self.reduce = Product(tensors.affine("reduce", width, few)[0])  # the bias cancels in differences
        self.channels = TwoProducts(tensors.two_layer("mix_channels", few, few, few))
        self.neighbors = TwoProducts(tensors.two_layer("mix_neighbors", near, near, near))
        self.collapse = TwoProducts(tensors.two_layer("collapse", near, near, 1))
        self.restore = Product(*tensors.affine("restore", few, width))

    def __call__(self, field: Float32Array, index: IntArray) -> Float32Array:
        f = self.reduce(field)
        num, width, rows = f.shape
        f = f.reshape(num * width, 1, rows)
        h = f - f[:, 0].take(index, axis=1).reshape(num * width, -1, rows)
        h = h.reshape(num, width, -1)
        h += self.channels(h)
        g = h.reshape(num * width, -1, rows)
        g += self.neighbors(g)
        change = self.restore(self.collapse(g).reshape(num, width, rows))
        return np.add(change, field, out=change) if self.residual else change


class _Gather:
    """Sub-fields attend to the correspondences that the prior keeps."""

    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        self.prior, self.heads, width = config.prior, config.num_heads, config.width
        scale = (width // self.heads) ** -0.5
        query, query_bias = tensors.affine("query", width, width)
        self.query = Product(query * scale, query_bias * scale)
        # A key's bias adds the same to every score of a query, which the softmax cancels.
        self.key = single(tensors.affine("key", width, width)[0].reshape(self.heads, -1, width))
        value, value_bias = tensors.affine("value", width, width)
        self.value = single(value.reshape(self.heads, -1, width))
        self.update = FoldedUpdate(tensors, width, value_bias)

    def __call__(self, z: Float32Array, field: Float32Array, logits: Float32Array | None) -> Float32Array:
        num, _, num_fields = z.shape
        if logits is not None and self.prior == "soft":
            field = field * np.maximum(np.tanh(logits), np.float32(0))[:, None]
        q = self.query(z).reshape(num, self.heads, -1, num_fields)
        into = np.matmul(q.swapaxes(2, 3), self.key).reshape(num, self.heads * num_fields, -1)
        scores = np.matmul(into, field)
        if logits is not None and self.prior == "mask":
            # Finite, so that attention is uniform where all are rejected.
            # no weight after the softmax
            np.copyto(scores, np.float32(-1e9), where=(logits <= 0)[:, None])
        gathered = np.matmul(softmax(scores, 2), field.swapaxes(1, 2))
        gathered = gathered.reshape(num, self.heads, num_fields, -1)
        return self.update(z, np.matmul(self.value, gathered.swapaxes(2, 3)).reshape(z.shape))


class _Rebuild:
    """All correspondences attend to the sub-fields."""

    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        self.heads, width = config.num_heads, config.width
        scale = (width // self.heads) ** -0.5
        query, query_bias = tensors.affine("query", width, width)
        self.query = single((query * scale).reshape(self.heads, -1, width))
        self.query_bias = single((query_bias * scale).reshape(self.heads, -1, 1))
        key, value = tensors.affine("key", width, width), tensors.affine("value", width, width)
        # A key's bias adds the same to all scores of a correspondence.
        self.key_value = Product(np.vstack([key[0], value[0]]), np.vstack([0 * key[1], value[1]]))
        (first, first_bias), second = tensors.two_layer("update", 2 * width, 2 * width, width)
        message, message_bias = tensors.affine("message", width, width)
        self.own = Product(first[:, :width], first_bias + first[:, width:] @ message_bias)
        from_heads = (first[:, width:] @ message).reshape(-1, self.heads, width // self.heads)
        self.from_heads = single(from_heads.swapaxes(0, 1))
        self.second = Product(*second)

    def __call__(self, field: Float32Array, z: Float32Array) -> tuple[Float32Array, Float32Array]:
        """The field (B, width, N) rebuilt from z (B, width, M), and the attention (B, heads, M, N)."""
        num, width, num_fields = z.shape
        wide = self.heads * num_fields
        key_value = self.key_value(z)
        k = key_value[:, :width].reshape(num, self.heads, -1, num_fields).swapaxes(2, 3)
        v = key_value[:, width:].reshape(num, self.heads, -1, num_fields)
        scores = np.matmul(np.matmul(k, self.query).reshape(num, wide, -1), field)
        scores += np.matmul(k, self.query_bias).reshape(num, wide, 1)
        attention = softmax(scores.reshape(num, self.heads, num_fields, -1), 2)
        back = np.matmul(self.from_heads, v).swapaxes(1, 2).reshape(num, -1, wide)
        hidden = self.own(field)
        hidden += np.matmul(back, attention.reshape(num, wide, -1))
        rebuilt = self.second(relu(hidden))
        rebuilt += field
        return rebuilt, attention


class _Verdict:
    """Whether the motion is right, from means of the channels and of the field; see `layers.MotionVerdict`."""

    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        num = 3 * config.input_width + 1 + 2 * config.width
        self.attend = Product(tensors.affine("attend", config.width, 1)[0])  # the bias cancels
        scale, shift = tensors.scale_shift("norm", num)
        weight, bias = tensors.affine("hidden", num, FIXED.verdict_width)
        hidden: tuple[FloatArray, FloatArray] = (weight * scale.T, bias + weight @ shift)
        self.both = TwoProducts((hidden, tensors.affine("out", FIXED.verdict_width, 1)))

    def __call__(self, channels: Float32Array, field: Float32Array, together: Float32Array) -> Float32Array:
        """(B, N, C), (B, width, N) and (B, N) to (B,)."""
        means = channels.mean(axis=1)
        total = together.sum(axis=1, keepdims=True)
        kept = np.matmul(together[:, None], channels)[:, 0] / (total + np.float32(1e-3))
        attention = softmax(self.attend(field), 2)
        pooled = [
            means,
            np.log(np.maximum(means, np.float32(0)) + np.float32(FIXED.least_mean)),
            kept,
            np.log(total + np.float32(0.1)),
            field.mean(axis=2),
            np.matmul(field, attention.swapaxes(1, 2))[:, :, 0],
        ]
        verdict: Float32Array = self.both(np.concatenate(pooled, axis=1)[:, :, None])[:, 0, 0]
        return verdict
