"""Furniture of the user: scaled, turned, and of its real size where a catalogue tells it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from generated_rooms import write_models

from geomoe3d.data.rooms.models import open_library


def test_models_are_scaled_and_turned(tmp_path: Path) -> None:
    write_models(tmp_path / "models")
    library = open_library([tmp_path / "models"])
    assert {kind: len(models) for kind, models in library.models.items()} == {
        "chair": 1,
        "desk": 1,
        "sofa": 1,
        "table": 1,
        "wardrobe": 1,
    }
    piece = library.draw("desk", np.random.default_rng(0))
    assert piece is not None
    assert (piece.width, piece.depth, piece.height) == pytest.approx((1.4, 0.7, 0.75))
    assert np.allclose(piece.solids.bounds, [(-0.7, 0, 0), (0.7, 0.7, 0.75)])


def test_catalogue_gives_the_real_size(tmp_path: Path) -> None:
    import trimesh

    folder = tmp_path / "library"
    folder.mkdir()
    trimesh.creation.box(extents=(100, 50, 70)).export(folder / "m.obj")  # any unit, y up
    (folder / "PluginFurnitureCatalog.properties").write_text(
        "name#1=Big table\ncategory#1=Kitchen\nmodel#1=/m.obj\nwidth#1=160\ndepth#1=80\nheight#1=74\n"
        "name#2=Car\ncategory#2=Vehicles\nmodel#2=/m.obj\nwidth#2=160\ndepth#2=80\nheight#2=74\n"
        "name#3=Chair\ncategory#3=Kitchen\nmodel#3=/none.obj\nwidth#3=wide\n"
    )
    library = open_library([folder])
    assert len(library) == 1
    assert "entry 3" in library.unreadable[0]
    piece = library.draw("table", np.random.default_rng(0))
    assert piece is not None
    assert (piece.width, piece.depth, piece.height) == pytest.approx((1.6, 0.8, 0.74))
