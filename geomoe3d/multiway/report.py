"""What a survey of scans comes to: the model, and why a pair or a scan is not in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.edges import Edge, agrees, expected_error, predicted_motion
from geomoe3d.multiway.grouping import Group
from geomoe3d.multiway.model import EdgeReport, SceneGroup, SceneModel, file_poses
from geomoe3d.multiway.survey import PairKey, Survey
from geomoe3d.types import FloatArray


def describe_model(survey: Survey, folder: Path, groups: list[Group]) -> SceneModel:
    """The groups of two or more as a model, the rest with reasons."""
    origins = {k: shape.origin for k, shape in enumerate(survey.shapes)}
    placed = [group for group in groups if len(group.poses) > 1]
    made = []
    for group in placed:
        reference, poses = file_poses(group.poses, survey.scans, origins)
        made.append(SceneGroup(reference, poses, dict(group.poses), tuple(group.edges)))
    home = {scan: number for number, group in enumerate(placed) for scan in group.poses}
    kept = {id(edge) for group in placed for edge in group.edges}
    reports = [
        EdgeReport(
            survey.scans[edge.source].name,
            survey.scans[edge.target].name,
            id(edge) in kept,
            "" if id(edge) in kept else _why_rejected(survey, edge, home, placed),
            edge.confidence,
            _file_motion(survey, pair),
        )
        for pair, edge in sorted(survey.edges.items())
    ]
    unplaced = {
        survey.scans[k].name: _why_unplaced(survey, k) for k in range(len(survey.scans)) if k not in home
    }
    return SceneModel(
        folder,
        survey.voxel_size,
        tuple(survey.scans),
        tuple(made),
        unplaced,
        tuple(reports),
        len(survey.outcomes),
        {},
    )


def _file_motion(survey: Survey, pair: PairKey) -> FloatArray:
    result = survey.outcomes[pair].result
    assert result is not None
    return result.T_target_source


def _why_rejected(survey: Survey, edge: Edge, home: dict[int, int], groups: list[Group]) -> str:
    a, b = home.get(edge.source), home.get(edge.target)
    if edge.worth <= survey.rules.least_worth:
        return f"confidence {edge.confidence:.2f} is too low"
    if a is None or b is None or a != b:
        return "not enough speaks for it to tie its two scans"
    predicted = predicted_motion(edge.source, edge.target, groups[a].poses)
    shape, rules = survey.shapes[edge.source], survey.rules
    if agrees(predicted, edge.T_target_source, shape, rules.kept_tolerance, rules.kept_turn_deg):
        error = expected_error(edge, groups[a].poses, shape, rules.correlation)
        return f"what its two scans share holds them too loosely: the sensor may be {error:.2g} off"
    if agrees(predicted, edge.T_target_source, shape, rules.tolerance, rules.turn_deg):
        return "near the poses that the other pairs give, but not near enough"
    apart = float(
        np.linalg.norm(
            (inverse(predicted) @ edge.T_target_source @ np.append(shape.center, 1))[:3] - shape.center
        )
    )
    return f"it contradicts the poses that the other pairs give by {apart:.3g}"


def _why_unplaced(survey: Survey, scan: int) -> str:
    if scan in survey.unusable:
        return survey.unusable[scan]
    mine = [(edge, pair) for pair, edge in survey.edges.items() if scan in pair]
    tried = sum(scan in pair for pair in survey.outcomes)
    if not mine:
        return f"none of its {tried} pairs gave a motion"
    edge, pair = max(mine, key=lambda item: item[0].confidence)
    other = survey.scans[pair[0] if pair[1] == scan else pair[1]].name
    surest = f"its surest of {tried} pairs, with '{other}', has confidence {edge.confidence:.3f}"
    voices = sum(edge.worth > survey.rules.least_worth for edge, _ in mine)
    if voices > 1:
        least = 1 / (1 + np.exp(-survey.rules.least_worth))
        return f"{surest}, but its {voices} pairs above {least:.2g} do not agree on one place clearly enough"
    return f"{surest}, and nothing agrees with it: one pair must be surer, or two must agree"
