"""The choices that make up a GeoMoE network, as one typed configuration.

The defaults are the paper's network for clouds (5,552,536 parameters). Every point that the paper leaves
open, or on which its text and its released code disagree, is a switch here; docs/network.md says what was
chosen and why. Lengths are in voxels, so that one set of weights serves any unit.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from geomoe3d.config import Section

Frame = Literal["given", "principal", "hypothesis", "principal_hypothesis"]

ExtraChannel = Literal["compatibility", "hypothesis", "feature_distance", "ratio", "mutual", "aligned"]

Kind = Literal["geomoe", "pointcn", "oanet", "umatch", "dematch", "demo", "pointdsc"]

_PUBLISHED: dict[str, dict[str, Any]] = {
    "pointcn": {"num_layers": 12, "motion_form": "endpoints"},
    "oanet": {"num_layers": 2, "num_sub_fields": 500, "motion_form": "endpoints"},
    "umatch": {"num_layers": 6, "motion_form": "endpoints"},
    "dematch": {"num_layers": 5},
    "demo": {"num_layers": 4},
    "pointdsc": {"num_layers": 12, "motion_form": "endpoints"},
}
"""Of each baseline, what differs from GeoMoE's defaults."""

_USED: dict[str, tuple[str, ...]] = {
    "pointcn": ("motion_form", "correspondence_dim"),
    "oanet": ("motion_form", "num_sub_fields", "correspondence_dim"),
    "umatch": ("motion_form", "num_heads", "correspondence_dim"),
    "dematch": ("num_heads", "num_sub_fields", "correspondence_dim"),
    "demo": (
        "motion_form", "num_heads", "num_sub_fields", "num_neighbors", "context_width", "embedding_norm",
        "knn_space", "correspondence_dim",
    ),
    "pointdsc": ("motion_form", "compatibility_threshold"),
}  # fmt: skip
"""Of each baseline, the keys that mean something to it, beside those that mean something to all."""

_USED_BY_ALL = ("kind", "num_layers", "width", "unit_voxels", "frame")

CHANNEL_WIDTHS: dict[str, int] = {
    "compatibility": 4,
    "hypothesis": 4,
    "feature_distance": 1,
    "ratio": 1,
    "mutual": 1,
    "aligned": 22,
}


class NetworkConfig(Section):
    """Size, wiring and input form of `geomoe3d.networks.geomoe.GeoMoE`, or of one of its baselines.

    A baseline (``kind``) has its published sizes as defaults, and refuses keys that mean nothing to it.
    """

    kind: Kind = Field("geomoe", description="architecture; the other keys are GeoMoE's")
    correspondence_dim: Literal[4, 6] = Field(6, description="6: two 3D points, 4: two image points")
    num_layers: int = Field(8, ge=1)
    width: int = Field(128, ge=4, description="channels D of the motion field")
    num_sub_fields: int = Field(48, ge=1, description="sub-fields M that the field is decomposed into")
    num_neighbors: int = Field(8, ge=1, description="neighbours K in the local context, itself included")
    context_width: int = Field(8, ge=1, description="channels d' of the local context")
    num_heads: int = Field(4, ge=1)

    motion_form: Literal["difference", "endpoints", "none"] = Field(
        "difference", description="input [p, q-p], [p, q], or extra channels alone (blind to rigid motion)"
    )
    unit_voxels: float = Field(20.0, gt=0, description="voxels in one unit of the network's coordinates")
    frame: Frame = Field(
        "given", description="coordinates as given, or turned into a frame that follows from the pair"
    )
    embedding_norm: bool = Field(True, description="ContextNorm right after the embedding")
    extra_channels: tuple[ExtraChannel, ...] = Field((), description="channels beside the coordinates")
    knn_space: Literal["correspondence", "motion", "source", "compatibility"] = Field(
        "correspondence", description="where neighbours are sought; compatibility: strongest second order"
    )

    local_context: bool = Field(True, description="the Local Orthogonal Context")
    context_residual: bool = Field(True, description="add the layer's input after the local context")

    prior: Literal["mask", "soft", "none"] = Field(
        "mask", description="previous logits as key mask (> 0), as detached weights on the field, or unused"
    )
    spatial_path: bool = Field(True, description="self-attention between sub-fields")
    channel_path: Literal["scalar", "channelwise", "none"] = Field(
        "scalar", description="one gain per pair as released, one sigmoid gain per channel, or no path"
    )
    feed_forward: Literal["moe", "dense", "none"] = Field("moe", description="dense: equal active width")
    feed_forward_residual: bool = True
    num_experts: int = Field(4, ge=1)
    top_k: int = Field(2, ge=1)
    expert_width: int = Field(16, ge=1)
    router_order: Literal["top_k_softmax", "softmax_top_k"] = Field(
        "top_k_softmax", description="softmax over the chosen logits (weights sum to 1), or choose after it"
    )
    load_balance: Literal["normalised", "paper"] = Field(
        "normalised", description="T sum u^2 (1 = balanced) or (1/T) sum u^2"
    )

    compatibility_threshold: float = Field(2.0, gt=0, description="length difference allowed, in voxels")
    compatibility_full: int = Field(
        1024, ge=8, description="up to here every pair of correspondences is compared"
    )
    compatibility_anchors: int = Field(512, ge=8, description="columns compared with beyond that")
    hypothesis_size: int = Field(20, ge=3, description="correspondences in a local hypothesis")

    @model_validator(mode="before")
    @classmethod
    def _with_published_sizes(cls, values: Any) -> Any:
        kind = values.get("kind") if isinstance(values, dict) else None
        if kind not in _PUBLISHED:
            return values
        return {"feed_forward": "none", **_PUBLISHED[kind], **values}

    @model_validator(mode="after")
    def _check_kind(self) -> NetworkConfig:
        if self.kind == "geomoe":
            return self
        expected = {"feed_forward": "none", **_PUBLISHED[self.kind]}
        for name, of_key in type(self).model_fields.items():
            given = getattr(self, name)
            if name in (*_USED_BY_ALL, *_USED[self.kind]) or given == expected.get(name, of_key.default):
                continue
            raise ValueError(f"{name}={given} means nothing to the network '{self.kind}'; leave it out")
        if self.motion_form == "none":
            raise ValueError(
                f"the network '{self.kind}' needs coordinates: motion_form difference or endpoints"
            )
        return self

    @model_validator(mode="after")
    def _check(self) -> NetworkConfig:
        if self.width % self.num_heads:
            raise ValueError(f"width {self.width} is not a multiple of num_heads {self.num_heads}")
        if self.top_k > self.num_experts:
            raise ValueError(f"top_k {self.top_k} exceeds num_experts {self.num_experts}")
        if self.motion_form == "none" and not self.extra_channels:
            raise ValueError("motion_form none needs extra_channels, else the network sees nothing")
        if len(set(self.extra_channels)) != len(self.extra_channels):
            raise ValueError(f"extra_channels {list(self.extra_channels)} repeats a name")
        if self.judges_motions and (self.extra_channels != ("aligned",) or self.motion_form != "none"):
            raise ValueError("the channels 'aligned' stand alone: no other extra channel, motion_form none")
        if self.judges_motions and (self.knn_space != "source" or self.correspondence_dim != 6):
            raise ValueError("the channels 'aligned' need knn_space source and correspondence_dim 6")
        if self.frame != "given" and (self.motion_form == "none" or self.correspondence_dim != 6):
            raise ValueError(f"frame {self.frame} turns coordinates of 3D points; this network sees none")
        if self.compatibility_anchors > self.compatibility_full:
            raise ValueError(
                f"compatibility_anchors {self.compatibility_anchors} exceeds compatibility_full "
                f"{self.compatibility_full}: there would be fewer correspondences than anchors"
            )
        if self.correspondence_dim == 4 and self.needs_compatibility:
            raise ValueError("length compatibility holds between 3D points; correspondence_dim is 4")
        return self

    @property
    def needs_compatibility(self) -> bool:
        """Whether any input is computed from length compatibility."""
        used = {"compatibility", "hypothesis"} & set(self.extra_channels)
        return bool(used) or self.knn_space == "compatibility"

    @property
    def judges_motions(self) -> bool:
        """Whether the network sees a pair under a given motion, and says whether that motion is right."""
        return "aligned" in self.extra_channels

    @property
    def num_extra_channels(self) -> int:
        """Channels per correspondence beside the coordinates."""
        return sum(CHANNEL_WIDTHS[name] for name in self.extra_channels)

    @property
    def input_width(self) -> int:
        """Channels that enter the embedding."""
        return (0 if self.motion_form == "none" else self.correspondence_dim) + self.num_extra_channels
