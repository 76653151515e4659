"""Everything that decides a generated data set, typed; configs/data/*.yaml hold the same tree."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from geomoe3d.config import Section
from geomoe3d.data.rooms.relief import ReliefSettings
from geomoe3d.data.rooms.sensor import SensorSettings
from geomoe3d.data.rooms.walk import WalkSettings

GENERATOR_VERSION = 2
"""Raised whenever the same settings and seed give other bytes; stored in every data set."""


class SceneShares(Section):
    """Which kinds of scenes are made, as far as their material is given."""

    meshes: float = Field(0.06, ge=0, le=1, description="share of walks through whole scene meshes")
    models: float = Field(0.5, ge=0, le=1, description="share of the other scenes that mix in model folders")


class SynthesisSettings(Section):
    """Generated scenes and the fragments recorded in them."""

    recorder: Literal["camera", "scanner", "orbit"] = Field(
        "camera",
        description="what records: a depth camera that is carried about; laser scanners, spinning and on "
        "tripods, from places metres apart; or, for orbit, a camera around a single body",
    )
    fragments_per_scene: int = Field(12, ge=2, description="fragments recorded per scene")
    frames_per_fragment: int = Field(
        12, ge=2, description="depth frames fused into one; stand for 50 recorded ones"
    )
    clutter: tuple[float, float] = Field(
        (5.0, 60.0), description="range of small things per square metre of table or shelf, log-uniform"
    )
    shares: SceneShares = SceneShares()
    fusion_voxel: float = Field(0.012, gt=0, description="edge of the fusion grid, metres")
    grid: float = Field(0.025, gt=0, description="one point is kept per cell of this edge, metres")
    drift_metres: float = Field(0.008, ge=0, description="error of the tracked position after a fragment")
    drift_deg: float = Field(0.25, ge=0, description="error of each tracked angle after a fragment")
    min_points: int = Field(3000, ge=100, description="fragments with fewer points are left out")
    min_overlap: float = Field(0.1, ge=0, le=1, description="least overlap of a pair in gt.log")
    relief: ReliefSettings = ReliefSettings()
    sensor: SensorSettings = SensorSettings()
    walk: WalkSettings = WalkSettings()

    @model_validator(mode="after")
    def _check(self) -> SynthesisSettings:
        if not 0 <= self.clutter[0] <= self.clutter[1]:
            raise ValueError("clutter must be a range [low, high] with 0 <= low <= high")
        return self
