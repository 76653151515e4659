"""Which of two clouds the line takes first, whatever order the caller gave them in.

Matching goes from one cloud to the other, and so do refinement and what is asked of an answer; a pair and its
exchange would get two answers. So the line always runs the same way, and the answer is turned round where the caller
meant the other one. Place: between load and prepare.
"""

from __future__ import annotations

from geomoe3d.types import PointCloud


def in_order(first: PointCloud, second: PointCloud) -> bool:
    """Whether the line takes these clouds as they come: the one with more points first.

    Of equally many the one that spreads less, and of equal spreads the one whose numbers come first: what comes
    before is not changed by rounding.
    """
    if len(first) != len(second):
        return len(first) > len(second)
    spreads = [sum(float(column.var()) for column in cloud.points.T) for cloud in (first, second)]
    if spreads[0] != spreads[1]:
        return spreads[0] < spreads[1]
    return first.file_points.tobytes() <= second.file_points.tobytes()
