"""What the tests of generated rooms share: small settings, a clean sensor, one wall, a few models."""

from __future__ import annotations

from pathlib import Path

from geomoe3d.data.rooms.scenes import Scene
from geomoe3d.data.rooms.sensor import Camera, SensorSettings
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.settings import SynthesisSettings

TINY = SynthesisSettings(fragments_per_scene=2, frames_per_fragment=2, fusion_voxel=0.03, min_points=500)
CLEAN = SensorSettings(
    disparity_noise=0,
    disparity_step=1e-3,
    edge_shift=0,
    hole_share=0,
    bias=0,
    min_slope=0.02,
    full_slope=0.03,
)
SMALL = Camera(160, 120, 146.0)


def wall_scene() -> Scene:
    s = Solids()
    s.box((3.0, -5, -5), (0.1, 10, 10))
    return Scene("primitives", "wall", s, [(-1, -1, 1, 1)])


def write_models(folder: Path) -> None:
    import trimesh

    folder.mkdir()
    for name, extents in (("chair", (0.45, 0.9, 0.5)), ("desk", (1.4, 0.75, 0.7)), ("sofa", (1.8, 0.8, 0.9))):
        trimesh.creation.box(extents=extents).export(folder / f"{name}.obj")
    (folder / "table.obj").write_bytes(b"\x00\x01 this is no model")
    (folder / "wardrobe.glb").write_bytes(b"")
    (folder / "readme.txt").write_text("no model")
