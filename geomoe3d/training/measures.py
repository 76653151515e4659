"""How well a network does on labelled pairs: labels by precision, recall and F1, motions by recall.

A motion counts as found under 15 degrees and 6 voxels (30 cm at 5 cm voxels), by weighted Kabsch on the
last layer's weights alone; a pose of two images under 10 degrees of rotation and of direction, by the weighted
eight-point algorithm. Means are over pairs; an undefined precision or recall counts 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from geomoe3d.geometry.essential import decompose, pose_errors_deg, weighted_eight_point
from geomoe3d.geometry.kabsch import weighted_kabsch
from geomoe3d.networks.build import Network
from geomoe3d.networks.layers import weights_from_logits
from geomoe3d.training.batches import Batch, Sample, make_batch
from geomoe3d.training.config import RULES


def label_measures(logits: Tensor, labels: Tensor, mask: Tensor | None) -> dict[str, Tensor]:
    """(B,) precision, recall and f1 of ``logits > 0`` against labels (B, N)."""
    kept = logits > 0
    if mask is not None:
        kept = kept & mask
    hit = (kept & labels).sum(1).double()
    precision = hit / kept.sum(1).clamp(min=1)
    recall = hit / labels.sum(1).clamp(min=1)
    f1 = 2 * precision * recall / (precision + recall).clamp(min=1e-12)
    return {"precision": precision, "recall": recall, "f1": f1}


def motion_found(logits: Tensor, coordinates: Tensor, truth: Tensor, unit_voxels: float) -> Tensor:
    """(B,) bool: the weighted Kabsch motion lies within the limits of the benchmark.

    Coordinates (B, N, 6) and truth (B, 4, 4) are in network units. The translation is compared at the
    source centroid, the origin of those units.
    """
    weights = weights_from_logits(logits)
    fit = weighted_kabsch(coordinates[..., :3].double(), coordinates[..., 3:].double(), weights.double())
    T, truth = fit.T_target_source, truth.double()
    product = T[:, :3, :3].transpose(1, 2) @ truth[:, :3, :3]
    cosine = (product.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    angle = torch.rad2deg(torch.arccos(cosine.clamp(-1, 1)))
    offset = (T[:, :3, 3] - truth[:, :3, 3]).norm(dim=1) * unit_voxels
    found: Tensor = fit.valid & (angle < RULES.max_rotation_deg) & (offset < RULES.max_translation_voxels)
    return found


def pose_found(logits: Tensor, matches: Tensor, truth: Tensor) -> Tensor:
    """(B,) bool: the weighted eight-point pose of matches (B, N, 4) lies within ten degrees of the truth."""
    weights = weights_from_logits(logits)
    fit = weighted_eight_point(matches, weights)
    errors = torch.stack(pose_errors_deg(decompose(fit.E, matches, weights), truth))
    found: Tensor = fit.valid & (errors.amax(0) < 10.0)  # degrees
    return found


@torch.no_grad()
def measure_batch(logits: Tensor, batch: Batch, unit_voxels: float) -> dict[str, Tensor]:
    """(B,) of each measure for the last layer's logits (B, N)."""
    measures = label_measures(logits, batch.labels, batch.input.mask)
    points = batch.input.coordinates
    if points.shape[-1] == 4:
        found = pose_found(logits, points, batch.truth)
    else:
        found = motion_found(logits, points, batch.truth, unit_voxels)
    return {**measures, "registration_recall": found.double()}


@torch.no_grad()
def evaluate(
    model: Network, samples: list[Sample], device: torch.device, batch_size: int = 8
) -> dict[str, float]:
    """Mean measures over samples, with the model in evaluation mode (and put back).

    For a network that scores transforms they are those of the motion that it likes best, ``verdict_recall``
    being the share of pairs where that motion is right.
    """
    was_training = model.training
    model.eval()
    collected: dict[str, list[Tensor]] = {}
    for start in range(0, len(samples), batch_size):
        batch = make_batch(samples[start : start + batch_size]).to(device)
        inputs = batch.input
        output = model(inputs.coordinates, inputs.channels, inputs.neighbors, inputs.mask)
        measures = measure_batch(output.logits[-1], batch, model.config.unit_voxels)
        if output.verdict is not None and batch.right is not None:
            chosen = best_of_pair(output.verdict, batch.pair)
            measures = {name: values[chosen] for name, values in measures.items()}
            measures["verdict_recall"] = batch.right[chosen].double()
        for name, values in measures.items():
            collected.setdefault(name, []).append(values.cpu())
    model.train(was_training)
    return {name: float(torch.cat(values).mean()) for name, values in collected.items()}


def best_of_pair(verdict: Tensor, pair: Tensor) -> Tensor:
    """Of inputs (B,) grouped by pair (B,), the one with the largest verdict in each pair, by pair."""
    order = verdict.argsort(descending=True, stable=True)
    order = order[pair[order].argsort(stable=True)]
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = pair[order][1:] != pair[order][:-1]
    return order[first]
