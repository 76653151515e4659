"""The command line called in this process, with a registrar that answers at once."""

from __future__ import annotations

import os
import sys
import types
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.cli.errors import run
from geomoe3d.cli.main import geomoe3d
from geomoe3d.config import RegistrationConfig
from geomoe3d.decision.explanation import Explanation
from geomoe3d.filters.base import FilterOutput
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.result import RegistrationResult
from geomoe3d.types import CloudReport, Correspondences, PointCloud

ROOT = Path(__file__).parents[1]
TRUTH = make_transform(
    Rotation.from_euler("xyz", [20.0, -35.0, 110.0], degrees=True).as_matrix(),
    np.array([583394.123456789, -5283100.987654321, 498.0]),
)


def make_result(**changes):
    values = {
        "T_target_source": TRUTH,
        "status": "ok",
        "reasons": (),
        "confidence": 0.9731,
        "overlap": 0.561,
        "evidence": {},
        "num_correspondences": 4321,
        "num_inliers": 1234,
        "inlier_threshold": 0.11,
        "voxel_size": 0.055,
        "alternative": None,
        "information_matrix": np.eye(6),
        "information_center": np.zeros(3),
        "source": CloudReport("source.xyz", 81234, 12, 7, 3, 4900, (0.0, 0.0, 0.0)),
        "target": CloudReport("target.xyz", 71000, 0, 0, 0, 4100, (583000.0, -5283000.0, 0.0)),
        "seconds": {"load": 0.25, "match": 1.5, "total": 1.75},
        "config": RegistrationConfig().model_dump(),
        **changes,
    }
    return RegistrationResult(**values)


class FakeRegistrar:
    """Answers with what the test has put in place, and remembers what it was asked."""

    answer: RegistrationResult | BaseException
    noise = ""
    asked: list
    initial = None

    def __init__(self, config=None):
        self.config = config

    def register(
        self, source, target, *, initial=None, correspondences=None, sensors=(None, None), progress=None
    ):
        type(self).asked.append((source, target, self.config))
        type(self).initial = initial
        for stage in ("load", "decide"):
            progress(stage)
        if self.noise:
            print(self.noise)
            os.write(1, self.noise.encode())  # as native code does
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer

    def explain(
        self, source, target, *, initial=None, correspondences=None, sensors=(None, None), progress=None
    ):
        result = self.register(source, target, initial=initial, progress=progress)
        points = np.random.default_rng(0).normal(size=(50, 3))
        moved = transform_points(TRUTH, points)
        origin = np.round(moved.mean(axis=0))
        return Explanation(
            result=result,
            source=PointCloud(points),
            target=PointCloud(moved - origin, origin=origin),
            correspondences=Correspondences(np.column_stack([points, moved - origin])),
            weighed=FilterOutput(np.ones(50)),
            inliers=np.ones(50, dtype=bool),
        )


def install_registrar(monkeypatch):
    """Makes every verb of this process use a registrar that answers at once, and gives its class."""
    registrar = type("Fake", (FakeRegistrar,), {"answer": make_result(), "asked": []})
    module = types.SimpleNamespace(Registrar=registrar)
    monkeypatch.setitem(sys.modules, "geomoe3d.registration", module)
    monkeypatch.delenv("GEOMOE3D_TRACEBACK", raising=False)
    return registrar


def write_scans(tmp_path):
    """Two tiny files to name on the command line."""
    rng = np.random.default_rng(5)
    paths = []
    for name in ("source.xyz", "target.xyz"):
        np.savetxt(tmp_path / name, rng.normal(size=(40, 3)))
        paths.append(str(tmp_path / name))
    return paths


def call(*arguments):
    return run(geomoe3d, "geomoe3d", [str(argument) for argument in arguments])
