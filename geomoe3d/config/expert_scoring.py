"""Constants of scoring and refining."""

from __future__ import annotations

from geomoe3d.config.section import Section, constant


class SurfacesExpert(Section):
    """What the clouds say of a hypothesis (`scoring/surfaces.py`)."""

    pixel_deg: float = constant(2.5, "degrees", (0.1, 45), "pixels of what a sensor saw")
    num_random: int = constant(
        256, "features", (16, 100_000), "of the target, at random, per source point: p-values down to 1 / 257"
    )
    least_cosine: float = constant(
        0.7, "cosine", (-1, 1), "normals of one surface, estimated twice, differ by less than 45 degrees"
    )
    violation_weight: float = constant(
        10.0, "-", (0, 1000), "a tenth of the visible points in free space divides the score by e"
    )
    visible_floor: float = constant(
        0.05, "share", (0, 1), "fewer visible points than this make the violation rate unreliable"
    )


class NetworkExpert(Section):
    """What a network's verdict counts (`scoring/network.py`)."""

    weight: float = constant(0.5, "per logit", (0, 100), "of the verdict in the logarithm of the score")
    most: float = constant(8.0, "logit", (0, 100), "beyond which a verdict counts no more, for and against")
    unseen: float = constant(
        -3.0, "logit", (-100, 100), "most that is assumed of a hypothesis that it was not shown"
    )
    granted: float = constant(
        7.5,
        "logit",
        (-100, 100),
        "stands for the verdict on what matches and clouds settle without it",
        "1.1 to 12.8 of 92 such hypotheses of recorded pairs",
    )


class SurfaceNetworkExpert(Section):
    """What the verdict of the surface network counts (`scoring/surface_network.py`)."""

    weight: float = constant(
        0.5, "per logit", (0, 100), "of the verdict in the logarithm of the score", "docs/training.md"
    )
    most: float = constant(12.0, "logit", (0, 100), "beyond which a verdict counts no more, for and against")


class AlignmentExpert(Section):
    """Local alignment by GICP or ICP (`geometry/gicp.py`, `refinement/icp.py`)."""

    least_matched: int = constant(
        10, "points", (3, 100_000), "matching, below which an alignment is not believed"
    )
    most_turn_deg: float = constant(
        45.0,
        "degrees",
        (0.1, 180),
        "a local method that turns further has left the transform it was to polish",
    )
    most_shift: float = constant(
        6.0, "voxels", (0.1, 1000), "a local method that shifts further has left it too"
    )
    still: float = constant(
        0.01,
        "voxels",
        (1e-09, 1),
        "a smaller step ends it (and a turn of less than 0.1 degrees, the library's own)",
        "ten times less takes twice the steps for nothing",
    )
    margin: float = constant(
        2.5,
        "voxels",
        (0, 100),
        "beyond the reach: points may come nearer in the course, and normals need their neighbours",
    )
    normal_neighbors: int = constant(20, "points", (3, 1000), "that a normal and a covariance are fitted to")
    coarse_part: int = constant(
        3,
        "points",
        (1, 1000),
        "of so many near the target one takes part in the first course",
        "half the time",
    )
    coarse_neighbors: int = constant(10, "points", (3, 1000), "that their covariances are fitted to")
    coarse_steps: int = constant(15, "steps", (1, 1000), "of the first course at most")
    least_thinned: int = constant(
        600, "points", (0, 1_000_000), "near the target; fewer take part in both courses"
    )
