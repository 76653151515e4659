"""Open3D's compiled half alone, beside Open3D itself in one program."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

AFTER = """
core = open3d_core()
print('dash' in sys.modules, 'open3d' in sys.modules)
import open3d
print(open3d.geometry.PointCloud is core.geometry.PointCloud, callable(open3d.visualization.draw_plotly))
cloud = open3d.geometry.PointCloud(core.utility.Vector3dVector([[0.0, 0, 1]]))
print(open3d.t.geometry.PointCloud.from_legacy(cloud).point.positions.shape, open3d_core() is open3d)
"""
BEFORE = """
import open3d
print(open3d_core() is open3d)
"""


@pytest.mark.parametrize(
    ("then", "expected"),
    [(AFTER, ["False False", "True True", "SizeVector[1, 3] True"]), (BEFORE, ["True"])],
    ids=["before Open3D", "after Open3D"],
)
def test_open3d_is_complete_whoever_loads_it_first(then: str, expected: list[str]) -> None:
    code = "import sys\nfrom geomoe3d.runtime.open3d_core import open3d_core\n" + then
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == expected
