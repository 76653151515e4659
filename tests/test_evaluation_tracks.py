"""What each track gives a method: clouds, all matches, or the thousand that were published."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from posed_scans import real_root

from geomoe3d.data.threedmatch import iterate_fixed_correspondences
from geomoe3d.errors import InputError
from geomoe3d.evaluation.benchmarks import load_pairs
from geomoe3d.evaluation.tracks import TRACKS, InputMaker
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.sources import source_closure, source_hash


@pytest.mark.parametrize("track", TRACKS)
def test_input_of_a_track(posed_folder: Path, track: str) -> None:
    pair = load_pairs(str(posed_folder))[0]
    given = InputMaker(track, str(posed_folder), seed=5)(pair)
    assert given.seed == 5
    if track == "clouds":
        assert given.correspondences is None
        assert given.source.shape == given.target.shape == (6000, 3)
        return
    assert given.source is None
    rows = given.correspondences
    assert len(rows) == 1000 if track == "1k" else len(rows) > 1000
    assert len(np.unique(rows[:, :3], axis=0)) == len(rows)
    right = np.linalg.norm(transform_points(pair.T_target_source, rows[:, :3]) - rows[:, 3:], axis=1) < 0.1
    assert right.mean() > 0.1  # the features of this surface are distinctive
    assert np.array_equal(rows, InputMaker(track, str(posed_folder))(pair).correspondences)


def test_unknown_track() -> None:
    with pytest.raises(InputError, match="no track 'some'"):
        InputMaker("some", "3DMatch")


def test_matched_input_depends_on_the_code_that_matches(posed_folder: Path) -> None:
    pairs = load_pairs(str(posed_folder))
    keys = {track: set(InputMaker(track, str(posed_folder)).identity(pairs)) for track in TRACKS}
    assert keys["clouds"] == {"from", "files_sha256"}
    assert {"source_sha256", "preparation", "versions"} < keys["all"] == keys["1k"]
    known = InputMaker("all", str(posed_folder)).identity(pairs)["source_sha256"]
    assert known == [source_hash(name) for name in ("geomoe3d.data.describe", "geomoe3d.matching.nearest")]
    assert "geomoe3d.features.fpfh" in source_closure("geomoe3d.data.describe")


def test_published_pairs_and_their_fixed_correspondences() -> None:
    real_root()
    for benchmark, count in (("3DMatch", 843), ("3DLoMatch", 1044)):
        pairs = load_pairs(benchmark)
        assert len(pairs) == len({pair.id for pair in pairs}) == count
        maker = InputMaker("1k", benchmark)
        assert maker.identity(pairs)["from"] == "published 1k correspondences"
        fixed = iterate_fixed_correspondences(None, benchmark)
        for pair, expected in list(zip(pairs, fixed, strict=True))[:: count // 20]:
            assert pair.id == f"{expected.scene}/{expected.source_index}-{expected.target_index}"
            assert np.array_equal(maker(pair).correspondences, expected.points)
            assert np.allclose(pair.T_target_source, expected.T_target_source, atol=1e-6)
