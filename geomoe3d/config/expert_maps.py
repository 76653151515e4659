"""Constants of finding a scan in a map."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from geomoe3d.config.section import Section, constant


class MapsExpert(Section):
    """What a map keeps, and on which grids a scan is sought (`maps/map.py`, `maps/finding.py`, `maps/level.py`)."""

    larger_grid: float = constant(
        3.0,
        "ratio",
        (1, 1000),
        "of the voxel sizes that two clouds would get by themselves from which the larger is taken for a map",
        "of 1,941 pairs of scans the largest was 2.6, of a depth camera's view in its room three to four",
    )
    most_voxels: int = constant(
        4_000_000, "voxels", (1000, 1_000_000_000), "that a map keeps; of more its grid is made coarser"
    )
    usual_points: int = constant(
        30_000,
        "points",
        (100, 100_000_000),
        "least of the grid on which a map is described before any scan is known",
    )
    usual_share: int = constant(
        20, "-", (1, 10_000), "one of so many of the map's points, where that is more"
    )
    most_points: int = constant(
        1_000_000,
        "points",
        (1000, 1_000_000_000),
        "of it, and of the other grid on which a scan is sought in the end, at most: 40 s of one core, 220 MB",
    )
    least_described: int = constant(
        2000,
        "points",
        (100, 100_000_000),
        "of the coarser grids on which a map is described beforehand, at least",
    )
    asked_points: int = constant(
        300_000,
        "points",
        (1000, 1_000_000_000),
        "at most, of a grid on which a map is described because a scan asks for it",
    )
    around_points: int = constant(
        100_000,
        "points",
        (1000, 100_000_000),
        "at most, of what is described anew around the places that were found",
    )
    candidates: int = constant(4, "places", (1, 1000), "that are compared as pairs of scans are")
    largest_scan: float = constant(
        3.0, "ratio", (1, 1000), "of a scan's extent to the map's from which it is no part of it"
    )
    finer: float = constant(
        1.3, "ratio", (1, 10), "a grid whose voxels are so many times smaller than the scan's own serves it"
    )
    least_voxels: int = constant(
        200,
        "voxels",
        (10, 1_000_000),
        "that a scan fills on a grid that serves it: on coarse ones more is found",
    )
    sought_voxels: int = constant(
        1000,
        "voxels",
        (10, 1_000_000),
        "that a scan fills on the other grid on which it is sought in the end",
        "a fragment with 3,200 of them was missed in its room, and found with 1,100",
    )
    known: float = constant(
        0.1,
        "length",
        (0, 1),
        "of a mean direction to the sensors below which they saw a surface from everywhere",
    )
    least_points: int = constant(
        3, "points", (3, 1_000_000), "of the map, and of a scan, that must remain on a grid"
    )
    least_twin: int = constant(
        30, "points", (3, 1_000_000), "of the map around a place, by which copies of it are sought"
    )
    finest: float = constant(
        1.25,
        "voxels",
        (1, 100),
        "of what a map keeps, of the finest grid on which it is described beforehand",
    )
    least_weight: float = constant(
        1e-4, "1 - cosine", (1e-9, 1), "of two neighbours that face the same way: a tree holds no zeros"
    )
    facing_neighbors: int = constant(10, "points", (2, 1000), "along which the signs of normals are carried")


class PlacesExpert(Section):
    """Windows of a map and the transforms proposed in them (`maps/places.py`)."""

    asked: tuple[Annotated[int, Field(ge=10, le=1_000_000)], Annotated[int, Field(ge=10, le=1_000_000)]] = (
        constant(
            (600, 1000),
            "points",
            None,
            "of the scan that are matched, at first, and later and in maps of many places",
        )
    )
    reach: float = constant(0.95, "share", (0, 1), "of the scan's points within its radius")
    cell: float = constant(2 / 3, "radii", (0.01, 10), "edge of the cells of which windows are made")
    window: float = constant(1.25, "radii", (0.1, 10), "of a window, between the corners of its cells")
    apart: float = constant(0.6, "radii", (0, 10), "between the centres of two windows at least")
    voting: int = constant(
        200,
        "points",
        (10, 1_000_000),
        "of these that vote for windows",
        "of 24 queries in three rooms 900 had the right window among the first six 19 times, 450 20, 150 21 times",
    )
    most_votes: int = constant(
        60_000_000,
        "pairs",
        (1_000_000, 10**12),
        "of points of scan and map; in larger maps fewer of the scan's vote",
    )
    matches: tuple[Annotated[int, Field(ge=3, le=1_000_000)], Annotated[int, Field(ge=3, le=1_000_000)]] = (
        constant(
            (500, 1000),
            "matches",
            None,
            "of a window, from which transforms are proposed, at first and later",
        )
    )
    threshold: float = constant(3.0, "voxels", (0.1, 100), "of an inlier: what is compared is two apart")
    choices: int = constant(
        3,
        "matches",
        (1, 100),
        "of a point at most, where a scan has fewer points than matches are wanted",
        "of a fragment with 211 points 20 to 40 matches of three choices were right, 5 to 14 of one",
    )
    seeds: tuple[Annotated[int, Field(ge=1, le=100_000)], Annotated[int, Field(ge=1, le=100_000)]] = constant(
        (100, 500),
        "matches",
        None,
        "that consensus begins with, at first and later",
        "of 36 queries in three rooms 31 were found at first with 250 and with 100, in a fifth less time",
    )
    refined: tuple[Annotated[int, Field(ge=1, le=100_000)], Annotated[int, Field(ge=1, le=100_000)]] = (
        constant((10, 60), "hypotheses", None, "that consensus refines, at first and later")
    )


class LocatingExpert(Section):
    """Which places are looked at, and what is said of them (`maps/locate.py`)."""

    first_windows: tuple[Annotated[int, Field(ge=1, le=10_000)], Annotated[int, Field(ge=1, le=10_000)]] = (
        constant(
            (4, 6),
            "windows",
            None,
            "that are looked into in any case, at first, and later and in maps of many places",
        )
    )
    windows: int = constant(12, "windows", (1, 10_000), "that are looked into at first")
    more_windows: int = constant(
        24, "windows", (1, 10_000), "that are looked into where the first look is not ok"
    )
    plain: float = constant(
        0.65,
        "quick score",
        (0, 10),
        "that hardly any wrong transform reaches: no more windows are looked into",
    )
    plainest: float = constant(
        0.75,
        "quick score",
        (0, 10),
        "that no wrong transform reached in 24 queries: from it only windows of such places are looked into",
    )
    rival_votes: float = constant(
        0.8,
        "share",
        (0, 1),
        "of the votes of a window with such a transform, from which another may hold one",
        "the windows of ten rooms that are one had 0.8 to 1 of the votes of the best",
    )
    twin_share: float = constant(
        0.6,
        "share",
        (0, 1),
        "of the votes of the window that is likest to a place, from which another may be its copy too",
        "votes of a place for itself are no measure: copies that were scanned anew have 0.05 to 0.9 of them",
    )
    twin_windows: int = constant(
        4,
        "windows",
        (1, 1000),
        "that are looked into for copies, of those that share points and of the others",
    )
    twin_voters: int = constant(
        32, "points", (10, 1_000_000), "of the map around a place that vote for its copies"
    )
    twin_asked: int = constant(
        300,
        "points",
        (10, 1_000_000),
        "of the map around a place that are matched with a window: its copy has most of them",
    )
    twin_apart: float = constant(
        1.5, "radii", (1, 100), "of a scan between a place and a window, within which they share points"
    )
    kept: tuple[Annotated[int, Field(ge=1, le=10_000)], Annotated[int, Field(ge=1, le=10_000)]] = constant(
        (12, 36), "candidates", None, "that are different, at first and later"
    )
    polished: tuple[Annotated[int, Field(ge=1, le=10_000)], Annotated[int, Field(ge=1, le=10_000)]] = (
        constant((8, 36), "candidates", None, "that are drawn closer, at first and later")
    )
    worth_polishing: float = constant(
        0.4, "share", (0, 1), "of the best candidate's quick score, from which one is drawn closer"
    )
    polishing: Annotated[tuple[Annotated[float, Field(ge=0.1, le=100)], ...], Field(min_length=1)] = constant(
        (6.0, 5.0, 4.0, 3.0, 2.0, 2.0),
        "voxels",
        None,
        "within which points are matched, step by step",
    )
    per_window: tuple[Annotated[int, Field(ge=1, le=1000)], Annotated[int, Field(ge=1, le=1000)]] = constant(
        (6, 20), "hypotheses", None, "of a window, at first and later"
    )
    asked: int = constant(400, "points", (10, 1_000_000), "of the scan, in a quick look")
    asked_back: int = constant(800, "points", (10, 1_000_000), "of the map, in a quick look")
    seen_through: float = constant(
        4.0, "voxels", (0, 1000), "in front of what a sensor saw, from which on it saw through"
    )
    asked_sensors: int = constant(
        4, "sensors", (0, 10_000), "of a map, those nearest to where a scan would lie"
    )
    close: float = constant(
        0.75, "share", (0, 1), "of the best candidate's quick score: such places are looked at too"
    )
    checked_below: float = constant(
        0.998,
        "probability",
        (0, 1),
        "an ok answer of less confidence is shown to the surface network",
        "a stranger had 0.99; its verdict and that of the matches made -1.6, of 46 right answers 1.5 and more",
    )
    scale_deviation: float = constant(
        1.1,
        "-",
        (0.1, 100),
        "deviation of a scale measured in a map, in deviations of a pair",
        "of 208 right answers in maps it denies none, 1.0 one; of 24 scans 4 % off 1.35 let two more pass",
    )
    reach: float = constant(
        0.98, "share", (0, 1), "of the scan's points within its reach, beside which strays lie"
    )
    better: float = constant(
        1.05, "ratio", (1, 10), "of quick scores: what ends a further search, over what was known before"
    )
    damping: float = constant(
        1e-3, "points", (0, 1000), "added to what holds a transform that is drawn closer"
    )
    unseen: float = constant(
        0.05,
        "share",
        (0, 1),
        "of the map's points, for so many that stand where the scan's sensor did not look",
    )
    margin: float = constant(
        6.0,
        "voxels",
        (0, 1000),
        "around the scan that are cut out of the map with it: a feature's radius and what it may be off",
    )


_Count = Annotated[int, Field(ge=1, le=1_000_000)]
_Counts = tuple[_Count, _Count, _Count]
_Reach = Annotated[float, Field(ge=0.1, le=100)]


class DetailExpert(Section):
    """A small scan against all that a map keeps (`maps/detail.py`)."""

    asked: _Counts = constant((100, 300, 600), "points", None, "of the scan, round by round")
    asked_back: int = constant(1500, "points", (10, 1_000_000), "of the map")
    finest: float = constant(
        1.25, "voxels", (1, 100), "of what a map keeps, of the grid of the scan at least"
    )
    reach: float = constant(2.3, "voxels", (0.1, 100), "within which a point has the map near it")
    gap: float = constant(
        0.5,
        "voxels",
        (0.01, 100),
        "between a point's plane and the map there",
        "of a lost wall the right place had 0.985, the best wrong one 0.87; on the map's grid 0.96 and 0.98",
    )
    seen_through: float = constant(
        2.0, "voxels", (0, 1000), "in front of what the scan's sensor saw, from which on it saw through"
    )
    polishing: tuple[_Reach, _Reach, _Reach] = constant(
        (8.0, 4.0, 2.5), "voxels", None, "within which points are matched, round by round"
    )
    steps: int = constant(3, "steps", (1, 100), "of a round, by which a transform is drawn closer")
    damping: float = constant(
        0.1, "points", (0, 1000), "added to what holds a transform that is drawn closer"
    )
    windows: int = constant(
        200,
        "windows",
        (1, 10_000),
        "that are looked into",
        "seven of eight small views had their place among the first 101",
    )
    around_points: int = constant(
        40_000,
        "points",
        (1000, 100_000_000),
        "at most, of what is described anew around the places that fit in detail",
    )
    per_window: int = constant(8, "hypotheses", (1, 1000), "of a window")
    per_window_polished: int = constant(3, "hypotheses", (1, 1000), "of a window, that are drawn closer")
    least: float = constant(0.35, "share", (0, 1), "of its points on the map's planes, of such a transform")
    compared: _Counts = constant((300, 80, 40), "transforms", None, "that are left after each round")
    close: float = constant(
        0.9, "share", (0, 1), "of the best score in detail, from which a place is compared as pairs are"
    )
    many_places: int = constant(
        1000,
        "windows",
        (1, 10_000_000),
        "of a map, from which a scan is compared in detail with many places, unless its answer is beyond doubt",
        "in a building of 40 rooms a view 2 m across was ok with 0.986 in a wrong room",
    )
