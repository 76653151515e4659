"""What a survey of scans comes to: the model, and why a pair or a scan is not in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geomoe3d.batch.store import Outcome
from geomoe3d.config import expert
from geomoe3d.decision.scale import DIFFERS
from geomoe3d.geometry.se3 import shift_frames
from geomoe3d.multiway.edges import Edge, agrees, differences, expected_error, predicted_motion
from geomoe3d.multiway.holding import is_denied
from geomoe3d.multiway.loops import closes_loops, find_loops
from geomoe3d.multiway.model import EdgeReport, LoopReport, SceneGroup, SceneModel, file_poses
from geomoe3d.multiway.pose_graph import spanning_tree
from geomoe3d.multiway.rules import Group
from geomoe3d.multiway.settling import is_kept
from geomoe3d.multiway.survey import Survey, key_of
from geomoe3d.runtime.words import counted

_DENIED = "with its scans there, sensors would have seen through surfaces"


def describe_model(
    survey: Survey, edges: Sequence[Edge], folder: Path, groups: list[Group], faults: Mapping[int, str]
) -> SceneModel:
    """The groups of two or more as a model, the rest with reasons.

    Args:
        survey: the scans and their pairs.
        edges: all of them, with what cycles say.
        folder: of the model.
        groups: from `geomoe3d.multiway.assembly.Assembly`.
        faults: what is wrong with scans as a whole, by number.
    """
    origins = {k: shape.origin for k, shape in enumerate(survey.shapes)}
    names = [scan.name for scan in survey.scans]
    placed = [group for group in groups if len(group.poses) > 1]
    home = {scan: group for group in placed for scan in group.poses}
    tree = spanning_tree([edge for group in placed for edge in group.edges])
    reports = [(edge, _report(survey, edge, home, tree)) for edge in edges]
    made = []
    for group in placed:
        reference, poses = file_poses(group.poses, survey.scans, origins)
        elsewhere = [
            k for k, one in enumerate(reports) if one[1].source in poses and _is_elsewhere(survey, *one)
        ]
        denied = {k for k in elsewhere if is_denied(survey, reports[k][0], group.poses)}
        for k in denied:
            edge, report = reports[k]
            reports[k] = edge, replace(report, reason=f"{report.reason}; {_DENIED}")
        heard = [edge for k, (edge, _) in enumerate(reports) if k not in denied]
        loops = tuple(
            LoopReport(tuple(names[k] for k in loop.scans), loop.shift, loop.turn_deg, loop.closes)
            for loop in find_loops(group.poses, heard, survey.shapes, survey.voxel_size)
        )
        contradictions = [
            reports[k][1] for k in elsewhere if k not in denied and _is_ok(survey, reports[k][0])
        ]
        contradictions.sort(key=lambda report: -report.confidence)
        made.append(
            SceneGroup(reference, poses, dict(group.poses), tuple(group.edges), loops, tuple(contradictions))
        )
    unplaced = {
        names[k]: faults.get(k) or _why_unplaced(survey, edges, k) for k in range(len(names)) if k not in home
    }
    return SceneModel(
        folder,
        survey.voxel_size,
        tuple(survey.scans),
        tuple(made),
        unplaced,
        tuple(report for _, report in reports),
        len(survey.outcomes) + len(survey.map_edges),
        {},
        {names[k]: told for k, told in faults.items() if k in home},
    )


def _is_ok(survey: Survey, edge: Edge) -> bool:
    """Whether registration alone was sure of a pair of scans."""
    outcome = _outcome(survey, edge)
    return outcome is not None and outcome.status == "ok"


def _outcome(survey: Survey, edge: Edge) -> Outcome | None:
    """What registration said of an edge, where it is that of a pair of scans."""
    if edge.of_maps or edge.given:
        return None
    return survey.outcomes.get(key_of(edge.source, edge.target))


def _is_elsewhere(survey: Survey, edge: Edge, report: EdgeReport) -> bool:
    """Whether a sure pair within a group moves its source farther from the poses than bends do."""
    if report.shift is None or report.turn_deg is None or not (_is_ok(survey, edge) or closes_loops(edge)):
        return False
    bent, rules = expert().many_groups.bent, survey.rules
    return report.shift > bent * rules.tolerance or report.turn_deg > bent * rules.turn_deg


def _report(survey: Survey, edge: Edge, home: dict[int, Group], tree: set[int]) -> EdgeReport:
    """What became of an edge, and why."""
    a, b = home.get(edge.source), home.get(edge.target)
    shape, rules = survey.shapes[edge.source], survey.rules
    shift: float | None = None
    turn: float | None = None
    if a is None or a is not b:
        fate = "between groups" if edge.worth > rules.least_worth else "rejected"
        reason = "not enough speaks for it to tie its two scans" if edge.worth > rules.least_worth else ""
    else:
        predicted = predicted_motion(edge.source, edge.target, a.poses)
        shifts, turns = differences(predicted[None], edge.T_target_source[None], [shape])
        shift, turn = float(shifts[0]), float(turns[0])
        near = any(edge is one for one in a.edges)
        kept = near and is_kept(edge, a.poses, survey.shapes, rules)
        fate, reason = ("kept" if kept else "near" if near else "rejected"), ""
        if near and not kept:
            reason = "near the poses that the other pairs give, but not near enough"
            if agrees(predicted, edge.T_target_source, shape, rules.kept_tolerance, rules.kept_turn_deg):
                error = expected_error(edge, a.poses, shape, rules.correlation)
                reason = f"what its two scans share holds them too loosely: the sensor may be {error:.2g} off"
        elif not near:
            reason = f"it contradicts the poses that the other pairs give by {shift:.3g} and {turn:.1f} deg"
    told = _outcome(survey, edge)
    if fate == "kept" and told is not None and told.result is not None:
        reason = next((said for said in told.result.reasons if said.startswith(DIFFERS)), "")
    if fate == "rejected" and edge.worth <= rules.least_worth:
        doubt = f"confidence {edge.confidence:.2f} is too low"
        if edge.prior > rules.least_worth:
            doubt = "other pairs of the same scans contradict it"
        reason = doubt if not reason else f"{doubt}; {reason}"
    if edge.given:
        reason = f"as the initial poses have it{f': {reason}' if reason else ''}"
    return EdgeReport(
        survey.scans[edge.source].name,
        survey.scans[edge.target].name,
        fate,
        reason,
        edge.confidence,
        float(1 / (1 + np.exp(-np.clip(edge.worth, -30, 30)))),
        shift,
        turn,
        fate in ("kept", "near") and id(edge) not in tree,
        edge.of_maps,
        shift_frames(edge.T_target_source, shape.origin, survey.shapes[edge.target].origin),
        edge.given,
    )


def _why_unplaced(survey: Survey, edges: Sequence[Edge], scan: int) -> str:
    if scan in survey.unusable:
        return survey.unusable[scan]
    mine = [edge for edge in edges if scan in (edge.source, edge.target)]
    tried = sum(scan in pair for pair in survey.outcomes)
    if not mine:
        return f"none of its {counted(tried, 'pair')} gave a transform"
    edge = max(mine, key=lambda edge: edge.confidence)
    other = survey.scans[edge.source if edge.target == scan else edge.target].name
    surest = f"its surest of {counted(tried, 'pair')}, with '{other}', has confidence {edge.confidence:.3f}"
    voices = sum(edge.worth > survey.rules.least_worth for edge in mine)
    if voices > 1:
        return f"{surest}, but its {voices} likely pairs do not agree on one place clearly enough"
    return f"{surest}, and nothing agrees with it: one pair must be surer, or two must agree"


def contradicted_steps(edges: Sequence[EdgeReport]) -> str:
    """A sentence where the initial poses have scans elsewhere than the model, else empty."""
    steps = [edge for edge in edges if edge.given and edge.shift is not None]
    wrong = [edge for edge in steps if edge.fate == "rejected"]
    if not wrong:
        return ""
    worst = max(wrong, key=lambda edge: edge.shift or 0.0)
    return (
        f"the initial poses contradict the scans: {len(wrong)} of their {counted(len(steps), 'step')} "
        f"from scan to scan, the worst from '{worst.target}' to '{worst.source}' by {worst.shift:.3g}; are they in "
        "the scans' unit, in their order, and of scan into world?"
    )
