"""Generated rooms: what stands in them, how flats are joined, whole scenes from their seed or a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geomoe3d.data.rooms.arrange import MAKERS, PROGRAMS
from geomoe3d.data.rooms.scenes import generate_scene, load_mesh_scene
from geomoe3d.data.rooms.shell import Room, join, overlaps, plan_flat
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.rooms.walk import WalkSettings, walk
from geomoe3d.errors import InputError


def test_solids_are_where_they_should_be() -> None:
    s = Solids()
    s.box((1, 2, 3), (0.5, 1.0, 2.0))
    assert np.allclose(s.bounds, [(1, 2, 3), (1.5, 3, 5)])
    s.rod((0, 0, 0), (0, 0, 4), 0.1)
    assert np.allclose(s.bounds[0], (-0.1, -0.1, 0), atol=1e-2)
    scene = Solids()
    scene.place(s, np.array([[0, -1.0, 0, 10], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    assert scene.bounds[0][0] == pytest.approx(10 - 3)


@pytest.mark.parametrize("name", sorted(MAKERS))
def test_every_piece_stands_on_its_floor_space(name: str) -> None:
    for seed in range(12):
        piece = MAKERS[name](np.random.default_rng(seed))
        low, high = piece.solids.bounds
        assert np.isfinite([low, high]).all()
        assert low[2] > -0.15
        assert 0.02 < high[2] < 2.6
        # Cushions, jackets and castors may stand out a little.
        slack = 0.3
        assert -piece.width / 2 - slack < low[0] < high[0] < piece.width / 2 + slack
        assert -slack < low[1] < high[1] < piece.depth + slack
        for shelf in piece.shelves:
            assert shelf.x[0] < shelf.x[1]
            assert shelf.y[0] < shelf.y[1]
            assert 0 < shelf.z <= high[2] + 0.1


def test_programs_name_known_pieces() -> None:
    assert {name for program in PROGRAMS.values() for name, _, _ in program} <= set(MAKERS)


def test_rooms_of_a_flat_are_apart_and_joined() -> None:
    for seed in range(8):
        rooms = plan_flat(np.random.default_rng(seed), 3)
        assert len(rooms) == 3
        for k, room in enumerate(rooms):
            assert not any(overlaps(room.rect, other.rect) for other in rooms[k + 1 :])
        passages = sum(
            o.kind in ("passage", "door ajar")
            for room in rooms
            for side in room.openings.values()
            for o in side
        )
        assert passages >= 2


def test_a_doorway_may_take_all_the_wall_that_two_rooms_share() -> None:
    for seed in range(300):
        rng = np.random.default_rng(seed)
        start, length = rng.uniform(0.0, 5.0), rng.uniform(1.3, 1.6)
        west = Room((0.0, 0.0, 3.0, 12.0), 2.5)
        east = Room((3.12, start, 6.0, start + length), 2.5)
        join(rng, [west, east])
        ((door,), (same,)) = west.openings["east"], east.openings["west"]
        assert (door.start, door.end) == (same.start, same.end)
        assert start + 0.1 - 1e-9 <= door.start < door.end <= start + length - 0.1 + 1e-9


def test_scene_depends_on_its_generator_alone() -> None:
    one, two = (generate_scene(np.random.default_rng(5)) for _ in range(2))
    other = generate_scene(np.random.default_rng(6))
    assert np.array_equal(np.concatenate(one.solids.vertices), np.concatenate(two.solids.vertices))
    assert one.solids.num_vertices != other.solids.num_vertices


def test_whole_scene_mesh(tmp_path: Path) -> None:
    import trimesh

    source = generate_scene(np.random.default_rng(11))
    mesh = trimesh.Trimesh(
        np.concatenate(source.solids.vertices), np.concatenate(source.solids.faces), process=False
    )
    mesh.export(tmp_path / "flat.ply")
    scene = load_mesh_scene(tmp_path / "flat.ply")
    assert scene.kind == "mesh"
    stands = walk(np.random.default_rng(0), scene, 4, WalkSettings())
    assert len(stands) == 4
    assert all(0.9 < stand.eye[2] < 1.9 for stand in stands)
    (tmp_path / "broken.ply").write_bytes(b"ply\n")
    with pytest.raises(InputError, match=r"broken\.ply"):
        load_mesh_scene(tmp_path / "broken.ply")
