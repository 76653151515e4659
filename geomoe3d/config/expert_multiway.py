"""Constants of many scans in one model."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from geomoe3d.config.section import Section, constant


class ManyPairsExpert(Section):
    """Which pairs of many scans are registered (`multiway/`: survey, proposals, maps, overlaps)."""

    closing_overlap: float = constant(
        0.3, "share", (0, 1), "by the poses, from which a pair that was not registered closes a loop"
    )
    closing_per_scan: int = constant(1, "pairs", (0, 1000), "that close loops")
    guessed_overlap: float = constant(0.1, "share", (0, 1), "by first poses, from which a pair is registered")
    odometry_confidence: float = constant(
        0.9, "probability", (0, 1), "of the transform between two scans by given poses"
    )
    odometry_points: float = constant(
        100.0,
        "points",
        (1, 100_000),
        "matched, that a given pose counts as; registered pairs have a thousand",
    )
    words: int = constant(
        64, "words", (2, 10_000), "into which features are sorted to find scans that look alike"
    )
    word_sample: int = constant(
        500, "features", (10, 1_000_000), "of each scan from which the words are found"
    )
    word_rounds: int = constant(12, "rounds", (1, 1000), "in which they are found")
    map_scans: int = constant(
        4, "scans", (1, 1000), "of a local map; of eight, what is not shared drowns what is"
    )
    map_edges: int = constant(
        3, "edges", (0, 1000), "between two groups, the surest, about which maps are made"
    )
    maps_per_groups: int = constant(6, "pairs", (0, 1000), "of maps of two groups")
    most_maps: int = constant(32, "pairs", (0, 10_000), "of maps in one round")
    whole_scans: int = constant(
        60,
        "scans",
        (0, 10_000),
        "of a group whose merged model is registered with those of other groups at most",
    )
    map_rounds: int = constant(2, "rounds", (0, 100), "of local maps")
    checked: int = constant(
        3,
        "pairs",
        (1, 100),
        "of scans that nothing sure ties to the rest, asked about mirrored axes and units",
    )
    checked_unplaced: int = constant(
        8,
        "pairs",
        (1, 100),
        "so asked of a scan that is not placed: those that it truly overlaps are hard to tell when it is mirrored",
    )
    most_checked: int = constant(60, "pairs", (0, 10_000), "so asked in all")
    initial_shift: float = constant(
        2.0, "voxels", (0.001, 1000), "standard deviation of given poses between two scans"
    )
    initial_turn_deg: float = constant(2.0, "degrees", (0.001, 180), "the same of their turn")
    overlap_reach: float = constant(
        1.5,
        "-",
        (0.1, 100),
        "times the distance between sampled points: a thinned surface has holes of that size",
    )
    overlap_sample: int = constant(
        400, "points", (10, 1_000_000), "of each scan by which overlaps are measured"
    )


class ManyGroupsExpert(Section):
    """Which edges are believed and groups joined (`multiway/`: assembly, cycles, edges, free space, loops)."""

    closing: tuple[
        Annotated[float, Field(gt=0, lt=1)],
        Annotated[float, Field(gt=0, lt=1)],
        Annotated[float, Field(gt=0, lt=1)],
        Annotated[float, Field(gt=0, lt=1)],
    ] = constant(
        (0.9, 0.02, 0.15, 0.02),
        "share",
        None,
        "of triangles that close though none, one, two or three of their edges are wrong",
        "of edges surer than 0.2 in four scenes with two wrong ones 7 to 21 %; with one wrong mostly near misses",
    )
    triangle_share: float = constant(
        0.5, "-", (0, 1), "of what each further triangle says: scans of one place are deceived alike"
    )
    most_told: float = constant(
        8.0, "log-odds", (0, 100), "that triangles give: no edge is certain to its neighbours"
    )
    rounds: int = constant(10, "rounds", (1, 1000), "of messages between edges")
    damping: float = constant(0.5, "-", (0, 1), "of what a round changes")
    least_confidence: float = constant(0.02, "probability", (0, 1), "edges below take no part")
    most_ambiguous: float = constant(
        0.5, "probability", (0, 1), "confidence of an edge with an equal rival: most pairs share nothing"
    )
    most_log_odds: float = constant(7.0, "log-odds", (0, 100), "of an edge by its confidence")
    unrelated: float = constant(
        1.5, "log-odds", (-100, 100), "taken off: the confidence is that of pairs of which most overlap"
    )
    most_doubted: float = constant(
        0.5,
        "probability",
        (0, 1),
        "most confidence of a doubted answer: of 95 among many scans 29 were right",
    )
    least_observability: float = constant(
        0.001, "share", (0, 1), "of the strongest direction that weaker ones are held by"
    )
    seen_sample: int = constant(
        300, "points", (10, 1_000_000), "of a scan that are asked whether another saw through them"
    )
    usual: float = constant(0.01, "share", (0, 1), "of points seen through under right transforms")
    usual_bent: float = constant(
        0.025,
        "share",
        (0, 1),
        "the same where groups are bent to be joined",
        "in halves of hotel_umd and lab_hj under 0.035 to 0.044 for 95 % of right joints, over 0.054 for 95 % of wrong",
    )
    against: float = constant(
        10.0,
        "log-odds",
        (0, 1000),
        "against a transform per share of a scan that another saw through beyond that",
    )
    anew: float = constant(
        10.0,
        "scans",
        (0.01, 1000),
        "of points, over all pairs, that say something of their own; the rest repeats it",
    )
    most_for: float = constant(4.0, "log-odds", (0, 100), "for a transform that no scan contradicts")
    half_seen: float = constant(15.0, "scans", (0.01, 1000), "of points, over all pairs, for half of that")
    seen_margin: float = constant(
        3.0, "voxels", (0, 100), "in front of what a sensor saw: scans are bent, poses not exact"
    )
    hopeless: float = constant(
        -6.0,
        "log-odds",
        (-1000, 0),
        "by free space, below which surfaces, which win back three at most, are not asked, and many edges count as one",
    )
    most_transforms: int = constant(
        8, "transforms", (1, 100), "of two groups that are weighed against each other"
    )
    most_proposals: int = constant(
        60, "edges", (1, 10_000), "between two groups whose transforms are looked at, the surest"
    )
    most_worth: float = constant(8.0, "log-odds", (0, 100), "of an edge among its supporters")
    asked: int = constant(
        60,
        "scans",
        (1, 10_000),
        "of each group that are asked about a transform, the nearest to its edges: bounds the time",
    )
    bent: float = constant(
        3.0, "tolerances", (1, 100), "between transforms of bent groups that are no rivals: one place"
    )
    bends_from: int = constant(
        3, "scans", (2, 10_000), "of both groups that may be bent to be joined, where rigidly nothing is sure"
    )
    fitted_from: float = constant(
        1.25,
        "ratio of scans",
        (1.001, 100),
        "by which a group has grown by single scans when its poses are fitted anew",
    )
    rival: float = constant(
        0.25, "share", (0, 1), "of the worth of the best: a transform that the scans are asked about again"
    )
    loop_worth: float = constant(4.0, "log-odds", (0, 100), "of an edge whose loop is followed: about 0.98")
    loop_confidence: float = constant(
        0.99,
        "probability",
        (0, 1),
        "of a pair whose loop is followed whatever the other pairs say",
        "of 181 pairs of hotel_umd and lab_hj so sure all are right",
    )
    about: int = constant(
        8,
        "scans",
        (1, 1000),
        "about each end of a sure pair that contradicts the poses, asked whether they can lie as it says",
    )
    seen_more: float = constant(
        3.0,
        "-",
        (1, 1000),
        "times what they see through now, from which they deny it",
        "of 4 generated models and hotel_umd: 33 wrong pairs 1.7 % to 43 %, 3 right ones or of wrong scans 0 to 0.3 %",
    )
    seen_far_more: float = constant(
        30.0,
        "-",
        (1, 1000),
        "times what is seen through of the median scan, from which a scan is let go",
        "of two wrong ones of 100 and 300 laser scans 139 and 67; of right ones of the dev scenes 15 at most",
    )
    lone_worth: float = constant(
        4.0,
        "log-odds",
        (0, 100),
        "of the only pair that holds a scan, from which a small overlap is enough",
        "a wrong one of 300 laser scans 2.5 at an overlap of 0.13; right ones of the dev scenes 0.24 and more",
    )
    lone_overlap: float = constant(0.2, "share", (0, 1), "both ways, that it needs otherwise")
    loop_shift: float = constant(
        4.0,
        "voxels",
        (0.01, 1000),
        "of a loop of three edges; errors add up as the square root of the length",
    )
    loop_turn_deg: float = constant(8.0, "degrees", (0.01, 180), "the same of its turn")
    most_turns: int = constant(
        3, "rounds", (1, 100), "in which groups are joined and what they hold is told to the edges"
    )
    silent_overlaps: tuple[
        Annotated[float, Field(ge=0, le=1)],
        Annotated[float, Field(ge=0, le=1)],
        Annotated[float, Field(ge=0, le=1)],
    ] = constant(
        (0.3, 0.2, 0.1),
        "share",
        None,
        "least overlaps both ways by a transform; a registered pair that says otherwise speaks against it",
    )
    silent_odds: tuple[
        Annotated[float, Field(ge=0, le=100)],
        Annotated[float, Field(ge=0, le=100)],
        Annotated[float, Field(ge=0, le=100)],
    ] = constant(
        (2.5, 1.0, 0.4),
        "log-odds",
        None,
        "how much it speaks against it",
        "of pairs that overlap by 0.3, 0.2 and 0.1 and more 98, 87 and 66 % are right",
    )
    shared_silence: float = constant(
        0.5, "-", (0, 1), "of that: what makes one pair fail makes its neighbours fail"
    )
    in_sequence: float = constant(
        3.0, "log-odds", (0, 100), "that scans taken one after the other overlap, beyond what others have"
    )


class ManyPosesExpert(Section):
    """How the poses of many scans are fitted (`multiway/`: alignment, pose_graph, settling)."""

    tolerances: tuple[
        Annotated[float, Field(ge=0.01, le=1000)],
        Annotated[float, Field(ge=0.01, le=1000)],
        Annotated[float, Field(ge=0.01, le=1000)],
        Annotated[float, Field(ge=0.01, le=1000)],
    ] = constant(
        (4.0, 2.5, 1.5, 3.0),
        "voxels",
        None,
        "of transforms that agree: as groups are joined, near the poses, of kept edges, of their expected error",
    )
    num_points: int = constant(500, "points", (10, 1_000_000), "of each scan, asked about each neighbour")
    points_in_all: int = constant(
        3000, "points", (10, 1_000_000), "of each scan, asked about all neighbours together"
    )
    least_overlap: float = constant(0.1, "share", (0, 1), "of scans that are laid on each other")
    reaches: Annotated[tuple[Annotated[float, Field(ge=0.01, le=1000)], ...], Field(min_length=1)] = constant(
        (3.0, 3.0, 3.0, 2.5, 2.5, 2.0, 2.0, 1.5, 1.5, 1.5, 1.5, 1.5),
        "voxels",
        None,
        "within which points are matched, one step each",
    )
    group_reaches: Annotated[tuple[Annotated[float, Field(ge=0.01, le=1000)], ...], Field(min_length=1)] = (
        constant(
            (5.0, 4.0, 3.0, 3.0, 2.0, 2.0),
            "voxels",
            None,
            "the same of two groups that are laid on each other",
        )
    )
    still: float = constant(
        0.02, "voxels", (0, 10), "under which no scan moved in a step, so that the reach shrinks at once"
    )
    most_pairs: int = constant(30, "pairs", (1, 10_000), "of scans, asked for two groups")
    most_neighbors: int = constant(30, "scans", (1, 10_000), "in whose surfaces a scan is laid at most")
    neighbors_again: int = constant(5, "steps", (0, 1000), "before it is asked again who overlaps whom")
    moved_again: float = constant(
        0.5, "voxels", (0, 1000), "that a scan must have moved by then, or nothing new overlaps"
    )
    gap_scale: float = constant(
        0.3333333333333333, "reach", (0.001, 100), "a gap this large counts a quarter"
    )
    least_cosine: float = constant(0.7, "cosine", (-1, 1), "of the normals of matched points")
    damping: float = constant(0.001, "mean curvature", (0, 1), "what no surface holds stays where it was")
    loop_preference: float = constant(2.0, "-", (0, 1000), "of Open3D's optimiser for edges that close loops")
    pruned_below: float = constant(
        0.25, "-", (0, 1), "confidence of an edge in Open3D's optimiser below which it is left out"
    )
    most_steps: int = constant(100, "steps", (1, 100_000), "of GTSAM's optimiser")
    most_rounds: int = constant(
        6, "rounds", (1, 1000), "in which edges are taken in and left out until that stays"
    )
