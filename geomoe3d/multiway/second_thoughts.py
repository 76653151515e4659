"""Second thoughts: scans of a grown group that have a rival place are weighed again, against the whole group.

Place: after growth, before the group is settled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.edges import Edge, Shape, differences
from geomoe3d.multiway.grouping import Growth, Witness, lead
from geomoe3d.multiway.rules import Group, GroupingRules


def reconsidered(
    group: Group,
    edges: Sequence[Edge],
    shapes: Sequence[Shape],
    rules: GroupingRules,
    witness: Witness,
) -> list[Group]:
    """The group with every scan that has a rival place put where most speaks for it now, or let go.

    A scan that joined early was weighed against few others; now the whole model can be asked.

    Args:
        group: from `Growth`.
        edges, shapes, rules, witness: as `Growth` takes them.

    Returns:
        The group, and scans by themselves for which no place leads clearly enough.
    """
    released: list[Group] = []
    edges = [replace(e, evidence=0.0) for e in edges]  # what triangles say is what the model says
    for scan in sorted(group.poses) if len(group.poses) > 2 else ():
        rest = {k: T for k, T in group.poses.items() if k != scan}
        mine = [
            e for e in edges if scan in (e.source, e.target) and {e.source, e.target} <= group.poses.keys()
        ]
        ways = Growth([Group(rest), Group({scan: np.eye(4)})], mine, shapes, rules, witness).rivals()
        if len(ways) < 2:
            continue
        found = ways[0].T_a_b if min(rest) < scan else inverse(ways[0].T_a_b)
        shift, turn = differences(group.poses[scan][None], found[None], [shapes[scan]])
        if shift[0] < 2 * rules.tolerance and turn[0] < 2 * rules.turn_deg:
            continue
        others = [e for e in group.edges if scan not in (e.source, e.target)]
        if lead(ways) >= rules.joined_worth:
            group = Group({**rest, scan: found}, [*others, *ways[0].supporters])
        else:
            group = Group(rest, others)
            released.append(Group({scan: np.eye(4)}))
    return [group, *released]
