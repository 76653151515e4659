"""Folded parts of GeoMoE that see only the M sub-fields, and how norms are folded into weights; numpy alone.

Used by `geomoe3d.networks.folded`; everything here works on one pair under B motions, (B, C, M) or (B, C, N).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import CheckpointError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.config import FIXED
from geomoe3d.types import Float32Array, FloatArray, IntArray

Affine = tuple[FloatArray, FloatArray]
"""Weight (out, in) and bias (out, 1)."""


class Tensors:
    """Tensors of a trained network by name, in double precision for folding; notes which were asked for.

    Args:
        tensors: as `torch.nn.Module.state_dict` names them.
    """

    def __init__(self, tensors: Mapping[str, NDArray[Any]]) -> None:
        self._tensors, self._left, self._prefix = tensors, set(tensors), ""

    def at(self, name: str) -> Tensors:
        """Those of one part."""
        part = Tensors({})
        part._tensors, part._left, part._prefix = self._tensors, self._left, f"{self._prefix}{name}."
        return part

    def array(self, name: str, *shape: int) -> FloatArray:
        """One tensor. Raises CheckpointError: missing or of another shape."""
        name = self._prefix + name
        found = self._tensors.get(name)
        if found is None or found.shape != shape:
            what = "is missing" if found is None else f"has the shape {found.shape}, not {shape}"
            raise CheckpointError(f"the weights do not fit their architecture: '{name}' {what}")
        self._left.discard(name)
        return found.astype(np.float64)

    def check_all_used(self) -> None:
        """Raises CheckpointError where a tensor was not asked for."""
        left = sorted(name for name in self._left if not name.endswith("num_batches_tracked"))
        if left:
            raise CheckpointError(
                f"the weights do not fit their architecture: {len(left)} are unknown, e.g. '{left[0]}'"
            )

    def affine(self, name: str, num_in: int, num_out: int) -> Affine:
        """A 1x1 convolution."""
        part = self.at(name)
        return part.array("weight", num_out, num_in, 1)[:, :, 0], part.array("bias", num_out)[:, None]

    def scale_shift(self, name: str, width: int) -> Affine:
        """A batch norm in evaluation as x * scale + shift, each (C, 1)."""
        part = self.at(name)
        scale = part.array("weight", width) / np.sqrt(part.array("running_var", width) + FIXED.batch_norm_eps)
        return scale[:, None], (part.array("bias", width) - part.array("running_mean", width) * scale)[
            :, None
        ]

    def two_layer(self, name: str, num_in: int, num_hidden: int, num_out: int) -> tuple[Affine, Affine]:
        """Two 1x1 convolutions, the norm between them folded into the first."""
        part = self.at(name)
        weight, bias = part.affine("linear1", num_in, num_hidden)
        scale, shift = part.scale_shift("norm", num_hidden)
        return (weight * scale, bias * scale + shift), part.affine("linear2", num_hidden, num_out)


def single(x: FloatArray) -> Float32Array:
    """In single precision, without gaps in memory."""
    return np.ascontiguousarray(x, dtype=np.float32)


class Product:
    """Weight (O, C) times every x (B, C, N), plus bias (O, 1) where there is one."""

    def __init__(self, weight: FloatArray, bias: FloatArray | None = None) -> None:
        self.weight, self.bias = single(weight), None if bias is None else single(bias)

    def __call__(self, x: Float32Array) -> Float32Array:
        """(B, C, N) to (B, O, N)."""
        y: Float32Array = np.matmul(self.weight, x)
        if self.bias is not None:
            y += self.bias
        return y


class TwoProducts:
    """Affine, ReLU, affine."""

    def __init__(self, both: tuple[Affine, Affine]) -> None:
        self.first, self.second = (Product(*one) for one in both)

    def __call__(self, x: Float32Array) -> Float32Array:
        """(B, C, N) to (B, O, N)."""
        return self.second(relu(self.first(x)))


class NormRelu:
    """ReLU of a batch norm, of a context norm over the last axis where that leads."""

    def __init__(self, norm: Affine, *, context: bool) -> None:
        self.scale, self.shift = map(single, norm)
        self.context = context

    def __call__(self, x: Float32Array) -> Float32Array:
        """(B, C, N) to the same shape."""
        if not self.context:
            h = x * self.scale
        else:
            h = x - x.mean(axis=-1, keepdims=True)
            variance = np.einsum("bcn,bcn->bc", h, h)[..., None] / np.float32(x.shape[-1])
            h *= self.scale / np.sqrt(variance + np.float32(FIXED.context_norm_eps))
        h += self.shift
        return relu(h)


def relu(x: Float32Array) -> Float32Array:
    """In place."""
    np.maximum(x, np.float32(0), out=x)
    return x


def softmax(x: Float32Array, axis: int) -> Float32Array:
    """In place."""
    x -= x.max(axis=axis, keepdims=True)
    np.exp(x, out=x)
    x /= x.sum(axis=axis, keepdims=True)
    return x


class FoldedUpdate:
    """a + TwoLayer(concat[a, message(heads)]) with the message folded into the first layer.

    Args:
        tensors: of the attention whose message and update these are.
        width: channels.
        value_bias: left out of the heads; attention sums to one, so it is a constant of the message.
    """

    def __init__(self, tensors: Tensors, width: int, value_bias: FloatArray) -> None:
        (first, first_bias), second = tensors.two_layer("update", 2 * width, 2 * width, width)
        message, message_bias = tensors.affine("message", width, width)
        own, heads = first[:, :width], first[:, width:] @ message
        bias = first_bias + first[:, width:] @ (message_bias + message @ value_bias)
        self.both = TwoProducts(((np.hstack([own, heads]), bias), second))

    def __call__(self, a: Float32Array, heads: Float32Array) -> Float32Array:
        """Both (B, C, M) to the updated a."""
        change = self.both(np.concatenate([a, heads], axis=1))
        change += a
        return change


class _Among:
    """Sub-fields attend to each other."""

    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        width, self.heads = config.width, config.num_heads
        parts = [tensors.affine(name, width, width) for name in ("query", "key", "value")]
        value_bias = parts[2][1]
        scale = (width // self.heads) ** -0.5
        self.all = Product(
            np.vstack([parts[0][0] * scale, parts[1][0], parts[2][0]]),
            np.vstack([parts[0][1] * scale, parts[1][1], np.zeros_like(value_bias)]),
        )
        self.update = FoldedUpdate(tensors, width, value_bias)

    def __call__(self, z: Float32Array) -> Float32Array:
        num, _, num_fields = z.shape
        parts = self.all(z).reshape(num, 3, self.heads, -1, num_fields)
        q, k, v = parts[:, 0], parts[:, 1], parts[:, 2]
        attention = softmax(np.matmul(q.swapaxes(2, 3), k), 3)
        return self.update(z, np.matmul(v, attention.swapaxes(2, 3)).reshape(z.shape))


class FoldedRectifier:
    """Both paths, their fusion and the experts."""

    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        width, self.form = config.width, config.channel_path
        self.gain = None
        if self.form == "scalar":
            self.gain = TwoProducts(tensors.two_layer("channel.gain", width, width, 1))
        elif self.form == "channelwise":
            first, second = (tensors.affine(f"channel.gain.{k}", width, width) for k in (0, 2))
            self.gain = TwoProducts((first, second))
        self.spatial = _Among(tensors.at("spatial"), config) if config.spatial_path else None
        wide = width * ((self.gain is not None) + (self.spatial is not None))
        self.fuse = TwoProducts(tensors.two_layer("fuse", wide, wide, width)) if wide else None
        self.experts = FoldedExperts(tensors.at("experts"), config)

    def __call__(self, z: Float32Array) -> tuple[Float32Array, IntArray | None]:
        """Sub-fields (B, C, M) rectified, and the main expert (B, M) of each."""
        paths = []
        if self.gain is not None:
            gain = self.gain(z.mean(axis=2, keepdims=True))
            paths.append(z * (1 / (1 + np.exp(-gain)) if self.form == "channelwise" else gain))
        if self.spatial is not None:
            paths.append(self.spatial(z))
        return self.experts(z if self.fuse is None else self.fuse(np.concatenate(paths, axis=1)))


class FoldedExperts:
    """F-MoE, its dense stand-in or nothing, with the residual."""

    def __init__(self, tensors: Tensors, config: NetworkConfig) -> None:
        self.config = config
        width, num, inner = config.width, config.num_experts, config.expert_width
        body = tensors.at("body")
        if config.feed_forward == "dense":
            wide = config.top_k * inner
            self.dense = TwoProducts((body.affine("up", width, wide), body.affine("down", wide, width)))
        elif config.feed_forward == "moe":
            self.router = TwoProducts(body.two_layer("router", width, width, num))
            up = body.array("up_weight", num, inner, width).reshape(-1, width)
            self.up = Product(up, body.array("up_bias", num, inner).reshape(-1, 1))
            # Hidden units and, for the biases, the expert weights themselves go down in one product.
            down = body.array("down_weight", num, width, inner).swapaxes(0, 1).reshape(width, -1)
            self.down = Product(np.hstack([down, body.array("down_bias", num, width).T]))

    def __call__(self, z: Float32Array) -> tuple[Float32Array, IntArray | None]:
        """The sub-fields (B, C, M) after their experts, and the main expert (B, M) of each."""
        main = None
        if self.config.feed_forward == "none":
            return z, None
        if self.config.feed_forward == "dense":
            change = self.dense(z)
        else:
            weights = _expert_weights(self.router(z), self.config.top_k, self.config.router_order)
            num, experts, num_fields = weights.shape
            hidden = relu(self.up(z)).reshape(num, experts, -1, num_fields)
            hidden *= weights[:, :, None]
            change = self.down(np.concatenate([hidden.reshape(num, -1, num_fields), weights], axis=1))
            main = weights.argmax(axis=1)
        if self.config.feed_forward_residual:
            change += z
        return change, main


def _expert_weights(logits: Float32Array, top_k: int, order: str) -> Float32Array:
    """Router logits (B, T, M) to the weights of the chosen experts, zero elsewhere."""
    chosen = np.argsort(-logits, axis=1, kind="stable")[:, :top_k]
    if order == "softmax_top_k":
        kept = np.take_along_axis(softmax(logits, 1), chosen, axis=1)
    else:
        kept = softmax(np.take_along_axis(logits, chosen, axis=1), 1)
    weights = np.zeros_like(logits)
    np.put_along_axis(weights, chosen, kept, axis=1)
    return weights
