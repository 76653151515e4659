"""What the network is trained for: right labels, a right motion, experts that share the work, a true verdict.

The first three are computed per layer and summed over the layers, as in the paper; the verdict is one. All
work on padded batches, in float32 outside autocast, and all gradients are finite for degenerate pairs (no
inlier, no positive weight, collinear points). Cost: linear in N.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F  # noqa: N812
from pydantic import Field
from torch import Tensor

from geomoe3d.config import Section
from geomoe3d.geometry.essential import (
    MIN_MATCHES,
    essential_of,
    symmetric_distance,
    virtual_matches,
    weighted_eight_point,
)
from geomoe3d.geometry.kabsch import weighted_kabsch
from geomoe3d.networks.geomoe import GeoMoEOutput
from geomoe3d.networks.layers import weights_from_logits


class LossConfig(Section):
    """Weights and forms of the terms."""

    regression_weight: float = Field(0.5, ge=0, description="of the geometric term after the warm-up")
    regression_warmup: float = Field(0.04, ge=0, le=1, description="share of the schedule without it")
    regression_form: Literal["clamp", "geman_mcclure"] = Field(
        "clamp", description="min(d^2, margin) as published, or margin d^2 / (margin + d^2), never flat"
    )
    regression_margin: float = Field(
        1.0, gt=0, description="squared network units (1 unit: 20 voxels), 1 m^2 at 5 cm voxels"
    )
    virtual_points: int = Field(
        4, ge=2, description="per edge of the lattice in the source's box, or of the grid over an image"
    )
    balance_weight: float = Field(0.01, ge=0)
    classification_form: Literal["balanced", "plain"] = Field(
        "balanced", description="inliers and outliers weigh half each, as published, or by inlier_weight"
    )
    inlier_weight: float = Field(
        1.0,
        gt=0,
        description="of an inlier beside an outlier in the plain form; a logit is 0 at odds of 1 to it",
    )
    verdict_weight: float = Field(1.0, ge=0, description="of the verdict, for networks that score transforms")
    similarity_weight: float = Field(1.0, ge=0, description="of features being alike, for PointDSC")


@dataclass(frozen=True)
class Losses:
    """The terms of one batch; ``total`` is what is minimised.

    Attributes:
        total: scalar.
        classification: scalar, summed over layers.
        regression: scalar, summed over layers, before its weight.
        balance: scalar, mean over layers.
        num_unsolved: layer-pairs left out of the regression because their weights fix no motion.
        verdict: scalar, 0 for a network that scores no transforms.
        similarity: scalar, 0 for a network that compares no features.
    """

    total: Tensor
    classification: Tensor
    regression: Tensor
    balance: Tensor
    num_unsolved: Tensor
    verdict: Tensor
    similarity: Tensor


def similarity_loss(similarity: Tensor, labels: Tensor, mask: Tensor | None) -> Tensor:
    """Mean square of similarity (B, N, N) minus 1 where both rows are inliers (B, N), 0 elsewhere.

    Source: the spectral matching loss of PointDSC (Bai et al., CVPR 2021), plain form; the diagonal is 0.
    """
    inlier = labels.float()
    wanted = inlier[:, :, None] * inlier[:, None]
    wanted = wanted * (1 - torch.eye(labels.shape[1], device=labels.device))
    square = (similarity.float() - wanted).square()
    if mask is None:
        return square.mean()
    both = (mask[:, :, None] & mask[:, None]).float()
    return ((square * both).sum((1, 2)) / both.sum((1, 2))).mean()


def verdict_loss(verdict: Tensor, right: Tensor, pair: Tensor) -> Tensor:
    """That a right motion is preferred to the wrong ones of its pair, and believed as far as is right.

    Args:
        verdict: (B,) logits.
        right: (B,) bool.
        pair: (B,) int64, which of P pairs each belongs to.

    Returns:
        Scalar: mean over pairs with a right and a wrong motion of -log sum_right softmax(verdict), plus the
        mean binary cross-entropy over all motions.
    """
    verdict = verdict.float()
    num = int(pair.max()) + 1
    table = verdict.new_full((num, len(pair)), -torch.inf)
    of_right = table.clone()
    columns = torch.arange(len(pair), device=pair.device)
    table = table.index_put((pair, columns), verdict)
    chosen = right.nonzero()[:, 0]
    of_right = of_right.index_put((pair[chosen], columns[chosen]), verdict[chosen])
    good = torch.zeros(num, device=pair.device).index_add(0, pair, right.float())
    bad = torch.zeros(num, device=pair.device).index_add(0, pair, (~right).float())
    both = (good > 0) & (bad > 0)
    preference = verdict.new_zeros(())
    if bool(both.any()):
        preference = (table[both].logsumexp(1) - of_right[both].logsumexp(1)).mean()
    return preference + F.binary_cross_entropy_with_logits(verdict, right.float())


def classification_loss(
    logits: Tensor,
    labels: Tensor,
    mask: Tensor | None = None,
    form: str = "balanced",
    inlier_weight: float = 1.0,
) -> Tensor:
    """Binary cross-entropy per pair: half for its inliers and half for its outliers, or plain.

    Args:
        logits: (..., B, N).
        labels: (B, N) bool, True for inliers.
        mask: (B, N) bool, False at padding, or None.
        form: ``balanced``, or ``plain``: the mean over rows.
        inlier_weight: w of an inlier in the plain form; a logit is then 0 at a probability of 1 / (1 + w).

    Returns:
        (...) mean over pairs. A side without members contributes 0.

    Source:
        0.5 mean_pos softplus(-z) + 0.5 mean_neg softplus(z).
    """
    logits = logits.float()
    if form == "plain":
        cost = F.binary_cross_entropy_with_logits(
            logits,
            labels.float().expand_as(logits),
            reduction="none",
            pos_weight=logits.new_tensor(inlier_weight),
        )
        return cost.mean(-1).mean(-1) if mask is None else ((cost * mask).sum(-1) / mask.sum(-1)).mean(-1)
    positive = labels if mask is None else labels & mask
    negative = ~labels if mask is None else ~labels & mask
    halves = []
    for side, sign in ((positive, -1.0), (negative, 1.0)):
        cost = F.softplus(sign * logits).masked_fill(~side, 0.0).sum(-1)
        halves.append(0.5 * cost / side.sum(-1).clamp(min=1))
    return (halves[0] + halves[1]).mean(-1)


def regression_loss(
    logits: Tensor, coordinates: Tensor, truth: Tensor, virtual: Tensor, config: LossConfig
) -> tuple[Tensor, Tensor]:
    """How far the weighted Kabsch motion carries virtual points from where the true motion does.

    Args:
        logits: (L, B, N), 0 or less at padding.
        coordinates: (B, N, 6) in network coordinates.
        truth: (B, 4, 4) true motion in network coordinates.
        virtual: (B, V, 3) points in the source frame; outlier targets are never touched.
        config: form and margin.

    Returns:
        (L,) mean over pairs, where a pair whose weights fix no motion counts 0; and how many those were.
    """
    weights = weights_from_logits(logits.float())
    points = coordinates.float()
    fit = weighted_kabsch(points[..., :3].expand(len(weights), -1, -1, -1), points[..., 3:], weights)
    solved = fit.valid & ((weights > 0).sum(-1) >= 3)  # three points fix a transform
    # Differences of the motions, so that nothing cancels.
    D = fit.T_target_source - truth.float()
    offset = virtual.float() @ D[..., :3, :3].transpose(-1, -2) + D[..., None, :3, 3]
    return _mean_cost(offset.square().sum(-1), solved, config)


def epipolar_loss(
    logits: Tensor, coordinates: Tensor, truth: Tensor, config: LossConfig
) -> tuple[Tensor, Tensor]:
    """How far matches that fit the true pose lie from the epipolar lines of the weighted eight-point solution.

    Args:
        logits: (L, B, N), 0 or less at padding.
        coordinates: (B, N, 4), normalised by the intrinsics.
        truth: (B, 4, 4) pose X1 = R X0 + t.
        config: form and margin of the squared distances, and how many virtual matches.

    Returns:
        As `regression_loss`.

    Source:
        The geometric loss of OANet (Zhang et al., ICCV 2019), with `virtual_matches` in place of its own.
    """
    weights = weights_from_logits(logits.float())
    fit = weighted_eight_point(coordinates.float(), weights)
    virtual = virtual_matches(essential_of(truth.double()), config.virtual_points)
    solved = fit.valid & ((weights > 0).sum(-1) >= MIN_MATCHES)
    return _mean_cost(symmetric_distance(fit.E, virtual), solved, config)


def _mean_cost(square: Tensor, solved: Tensor, config: LossConfig) -> tuple[Tensor, Tensor]:
    """Squared distances (L, B, V) to a cost (L,), and how many of ``solved`` (L, B) are not."""
    margin = config.regression_margin
    if config.regression_form == "clamp":
        cost = square.clamp(max=margin)
    else:
        cost = margin * square / (margin + square)
    return cost.mean(-1).masked_fill(~solved, 0.0).mean(-1), (~solved).sum()


def virtual_lattice(coordinates: Tensor, mask: Tensor | None, per_edge: int) -> Tensor:
    """(B, per_edge^3, 3) points evenly in the bounding box of each pair's source half."""
    source = coordinates[..., :3].float()
    if mask is None:
        low, high = source.amin(1), source.amax(1)
    else:
        low = source.masked_fill(~mask[..., None], torch.inf).amin(1)
        high = source.masked_fill(~mask[..., None], -torch.inf).amax(1)
    steps = torch.linspace(0, 1, per_edge, device=source.device)
    grid = torch.cartesian_prod(steps, steps, steps)
    return low[:, None] + grid * (high - low)[:, None]


def network_motion(
    correspondences: Tensor, T_target_source: Tensor, voxel_size: float, unit_voxels: float
) -> Tensor:
    """A motion between cloud frames as a motion between the network's centred, scaled frames.

    Args:
        correspondences: (N, 6) float64, whose halves' means are the frames' origins.
        T_target_source: (4, 4) float64.
        voxel_size: cloud units.
        unit_voxels: voxels in one network unit.

    Returns:
        (4, 4) float64.
    """
    T = T_target_source.clone().double()
    mean = correspondences.double().mean(dim=0)
    T[:3, 3] = (T[:3, :3] @ mean[:3] + T[:3, 3] - mean[3:]) / (voxel_size * unit_voxels)
    return T


def total_loss(
    output: GeoMoEOutput,
    coordinates: Tensor,
    labels: Tensor,
    truth: Tensor,
    mask: Tensor | None,
    config: LossConfig,
    progress: float,
    right: Tensor | None = None,
    pair: Tensor | None = None,
) -> Losses:
    """All terms at ``progress`` (0 to 1) of the schedule; before the warm-up ends no motion is solved."""
    classification = classification_loss(
        output.logits, labels, mask, config.classification_form, config.inlier_weight
    ).sum()
    regression = classification.new_zeros(())
    unsolved = torch.zeros((), dtype=torch.int64, device=classification.device)
    if config.regression_weight > 0 and progress >= config.regression_warmup:
        if coordinates.shape[-1] == 4:
            per_layer, unsolved = epipolar_loss(output.logits, coordinates, truth, config)
        else:
            virtual = virtual_lattice(coordinates, mask, config.virtual_points)
            per_layer, unsolved = regression_loss(output.logits, coordinates, truth, virtual, config)
        regression = per_layer.sum()
    total = classification + config.regression_weight * regression + config.balance_weight * output.balance
    verdict = classification.new_zeros(())
    if output.verdict is not None and right is not None and pair is not None:
        verdict = verdict_loss(output.verdict, right, pair)
        total = total + config.verdict_weight * verdict
    similarity = classification.new_zeros(())
    if output.similarity is not None:
        similarity = similarity_loss(output.similarity, labels, mask)
        total = total + config.similarity_weight * similarity
    return Losses(total, classification, regression, output.balance, unsolved, verdict, similarity)
