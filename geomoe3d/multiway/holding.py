"""What holds a scan in its place: too little, or against what the sensors saw; and sure pairs that would have it
elsewhere, which the sensors deny or not.

Place: after a group is settled. Scans of repeated rooms are deceived alike, so a few doubtful pairs may agree on a
wrong place, and one pair that shares little may look sure. The model itself tells what is usual in it: exact laser
scans see through a tenth of what bent fragments do. Cost: some 10 ms per scan or pair in question.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.maps import members_of
from geomoe3d.multiway.rules import Group, Poses
from geomoe3d.multiway.survey import Survey, key_of


def loosely_held(survey: Survey, group: Group) -> set[int]:
    """The scans of a settled group that are better let go.

    One that a single pair holds, which is not sure in the company of the others and shares little; and one of which far
    more is seen through than of the other scans.
    """
    known, poses = expert().many_groups, group.poses
    if len(poses) < 3:
        return set()
    held = Counter(scan for edge in group.edges for scan in (edge.source, edge.target))
    loose = set()
    for edge in group.edges:
        if not edge.expected and edge.worth < known.lone_worth and _shared(survey, edge) < known.lone_overlap:
            loose |= {scan for scan in (edge.source, edge.target) if held[scan] == 1}
    return loose | _seen_through(survey, poses)


def _seen_through(survey: Survey, poses: Poses) -> set[int]:
    """The scans of a group of which far more is seen through than of the others without them."""
    known, least, scans = expert().many_groups, expert().many_poses.least_overlap, sorted(poses)
    number = {scan: k for k, scan in enumerate(scans)}
    told = np.zeros((2, len(scans), len(scans)))  # seen, seen through
    for pair in {key_of(*pair) for pair in survey.overlaps.between(poses, poses, least)}:
        i, j = (number[scan] for scan in pair)
        one, other = ({scan: poses[scan]} for scan in pair)
        told[:, i, j] = told[:, j, i] = survey.free_space.between(one, other, np.eye(4))
    seen, through = told.sum(2)
    # Of every scan (column) what is seen through where another (row) is left out: that one may be the cause.
    rest, share = seen - told[0], through / np.maximum(seen, 1e-9)
    others = np.where(rest >= known.anew, (through - told[1]) / np.maximum(rest, 1e-9), np.nan)
    np.fill_diagonal(others, np.nan)
    asked = np.isfinite(others).any(1) & (seen >= known.anew)
    usual = np.full(len(scans), np.inf)
    usual[asked] = np.nanmedian(others[asked], axis=1)
    return {scans[k] for k in np.flatnonzero(share > np.maximum(known.usual, known.seen_far_more * usual))}


def is_denied(survey: Survey, edge: Edge, poses: Poses) -> bool:
    """Whether the scans about both ends of a pair cannot lie as it says: sensors saw through what would be there."""
    known, (i, j) = expert().many_groups, (edge.source, edge.target)
    about_i, about_j = (members_of(k, poses, survey.overlaps, known.about) for k in (i, j))
    mine, others = {k: poses[k] for k in about_i}, {k: poses[k] for k in about_j}
    seen = [survey.free_space.between(some, some, np.eye(4)) for some in (mine, others)]
    usual = max(known.usual, *(known.seen_more * _share(*one) for one in seen))
    moved = poses[j] @ edge.T_target_source @ inverse(poses[i])
    rest = {k: T for k, T in others.items() if k not in mine}
    return _share(*survey.free_space.between(rest, mine, moved)) > usual


def _shared(survey: Survey, edge: Edge) -> float:
    """The smaller overlap of the two scans of an edge, by its transform."""
    T = edge.T_target_source
    return min(
        survey.overlaps.of(edge.source, edge.target, T),
        survey.overlaps.of(edge.target, edge.source, inverse(T)),
    )


def _share(seen: float, through: float) -> float:
    return through / max(seen, 1e-9)
