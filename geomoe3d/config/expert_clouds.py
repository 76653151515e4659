"""Constants of loading and preparing a cloud."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from geomoe3d.config.section import Section, constant


class LoadingExpert(Section):
    """What becomes of a file's points (`clouds/loading.py`, `clouds/recentre.py`)."""

    most_coordinate: float = constant(
        1000000000000.0,
        "cloud units",
        (1.0, 1e15),
        "beyond which a coordinate, or the translation of a given pose, is an error",
    )
    least_extent: float = constant(
        1e-15, "cloud units", (0.0, 1e-3), "under which a cloud is an error: squares of lengths vanish"
    )
    dense_mesh: int = constant(
        50_000, "vertices", (1, 1_000_000_000), "of a mesh from which they are taken as they are, not sampled"
    )
    near_zero: float = constant(
        10.0, "spreads", (0.1, 1000), "of a cloud within which its median lies near zero"
    )
    outside_spread: float = constant(
        5.0, "percent", (0, 49), "of the points at either end of an axis, see there"
    )


class PreparationExpert(Section):
    """From points to a grid (`clouds/voxel_size.py`, `clouds/voxel_grid.py`)."""

    finest: float = constant(
        10_000.0,
        "cells",
        (10, 2**20),
        "of the extent, beyond which a grid that is still not full will not become so",
    )
    extent_sample: int = constant(
        100_000,
        "points",
        (100, 100_000_000),
        "looked at when a voxel size is chosen: density is known well enough by then",
    )
    outside_extent: float = constant(
        1.0,
        "percent",
        (0, 49),
        "of the points at either end of an axis that are strays and not of the extent",
    )
    middle_sample: int = constant(20_000, "points", (100, 100_000_000), "that the middle is found by")
    spacing_asked: int = constant(2000, "points", (10, 2000), "whose spacing is measured")
    spacing_sample: int = constant(
        8000, "points", (2000, 100_000_000), "nearest to the middle, of which the spacing is measured"
    )
    coarsening: float = constant(
        1.02, "ratio", (1, 10), "beyond what surfaces need by which voxels grow until they are few enough"
    )
    most_extent_ratio: int = constant(
        50, "ratio", (2, 1_000_000), "of two clouds' extents; beyond it one is in another unit"
    )
    ramp: float = constant(
        0.05, "voxels", (1e-06, 0.5), "from a voxel's wall within which a point counts less"
    )
    at_wall: float = constant(0.001, "-", (1e-09, 1), "what a point on a voxel's wall counts")
    least_held: float = constant(0.01, "points", (0, 1), "that a voxel must hold by these weights")
    full: float = constant(
        0.1, "points", (1e-06, 1), "by these weights from which a voxel counts fully when voxels are counted"
    )


class ViewpointExpert(Section):
    """Where a sensor stood (`clouds/viewpoint.py`)."""

    moved_mean: float = constant(
        0.025,
        "extents",
        (0, 1),
        "from the origin to the mean: nearer only where a cloud was moved there",
        "depth-camera fragments 0.36 at least, laser scans in rooms 0.037; of centred fragments 99 of 100 within 0.03",
    )
    moved_middle: float = constant(
        0.01,
        "extents",
        (0, 1),
        "from the origin to the middle of the box, likewise",
        "fragments 0.42 at least, laser scans in rooms 0.022",
    )
    moved_corner: float = constant(
        0.05,
        "extents",
        (0, 1),
        "from the origin to the lowest corner, likewise",
        "fragments 0.37 at least, laser scans in rooms 0.22",
    )
    moved_exactly: float = constant(
        0.003,
        "extents",
        (0, 1),
        "any of these three nearer: the cloud was moved there, whatever its points are like",
    )
    most_thinning: float = constant(
        -0.5,
        "rank correlation",
        (-1, 1),
        "of points in a cell and its distance from the origin, with which a sensor is believed there all the same",
        "raw scans all around -0.46 to -0.85; thinned ones, depth-camera frames, samples, merged clouds -0.37 at least",
    )
    thinning_cells: float = constant(60.0, "cells", (2, 10_000), "of which the extent has so many")
    thinning_points: int = constant(100_000, "points", (100, 100_000_000), "at most that are counted")
    most_sign_breaks: float = constant(
        0.025,
        "share",
        (0, 1),
        "of neighbours on a smooth surface that are turned to opposite sides",
        "scans 0.1 to 2.5 %, objects 1.5 to 4.6 %, and 3 % in one cloud of any pair of them",
    )
    sign_neighbors: int = constant(6, "points", (1, 1000), "nearest ones that a sign is held against")
    sign_reach: float = constant(2.5, "voxels", (0.1, 100), "within which they lie on one surface")
    smooth_cosine: float = constant(
        0.9, "cosine", (0, 1), "from which on two normals are of one smooth surface"
    )
    pixel_deg: float = constant(3.0, "degrees", (0.1, 45), "pixels in which visibility is asked")
    first_step: float = constant(
        0.15, "half diagonals", (0, 10), "by which the best places are moved at first"
    )
    reach: float = constant(
        1.3, "half extents", (0, 100), "from the middle, and a step, within which places are tried"
    )
    rounds: int = constant(4, "rounds", (0, 1000), "of improvement")
    trials: int = constant(8, "places", (1, 1000), "around each kept one in a round")
    narrowing: float = constant(1.7, "ratio", (1, 100), "of the steps of one round to those of the next")
    num_candidates: int = constant(200, "places", (1, 100_000), "tried for a sensor that is not known")
    num_kept: int = constant(4, "places", (1, 1000), "that are improved")
    num_points: int = constant(1500, "points", (10, 1_000_000), "whose visibility is asked")
    margin: float = constant(
        4.0, "voxels", (0, 100), "behind the nearest surface within which a point is visible"
    )
    least_visible: float = constant(0.85, "share", (0, 1), "below it the cloud was seen from several sides")
    grazing_cosine: float = constant(
        0.2, "cosine", (0, 1), "surfaces seen flatter than this return few points to a real sensor"
    )


class ScatterExpert(Section):
    """Whether points fill space as foliage does (`clouds/voxel_size.py`)."""

    sample: int = constant(20_000, "points", (100, 100_000_000), "of the cloud, thinned evenly")
    radius: float = constant(2.5, "voxels", (0.5, 100), "of a point's surroundings")
    least: int = constant(
        8, "points", (3, 1000), "that surroundings must hold, and surroundings that must do so"
    )
    asked: tuple[Annotated[int, Field(ge=3, le=100_000)], Annotated[int, Field(ge=3, le=100_000)]] = constant(
        (40, 400), "points", None, "whose surroundings are looked at, few at first"
    )
    variations: tuple[Annotated[float, Field(ge=0, le=0.3334)], Annotated[float, Field(ge=0, le=0.3334)]] = (
        constant(
            (0.11, 0.15),
            "share",
            None,
            "of the variance along the normal from which points fill space, 1/3 for what does",
            "51 recorded pairs and 72 fragments at most 0.13, airborne tiles and forest 0.17 to 0.19",
        )
    )
