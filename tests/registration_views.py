"""Views to be shown: two overlapping parts of a room, with a right motion, without one, or hostile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.result import RegistrationResult
from geomoe3d.types import Alternative, CloudReport
from geomoe3d.visual.view import RegistrationView

UTM = np.array([583394.0, 5283100.0, 498.0])
NASTY = "</script><b>x & {{data}} $\\frac$.ply"


def box_room(num: int, seed: int) -> np.ndarray:
    """Points of a 6 x 4.5 x 2.7 room without a ceiling, with three boxes; z up, walls along x and y."""
    rng = np.random.default_rng(seed)
    planes = [((0, 0, 0), (6, 0, 0), (0, 4.5, 0))]
    for origin, along in (
        ((0, 0, 0), (6, 0, 0)),
        ((0, 4.5, 0), (6, 0, 0)),
        ((0, 0, 0), (0, 4.5, 0)),
        ((6, 0, 0), (0, 4.5, 0)),
    ):
        planes.append((origin, along, (0, 0, 2.7)))
    for x, y, a, b, h in ((1, 1, 1.6, 0.8, 0.75), (4.5, 0.3, 0.6, 1.2, 1.9), (3, 3.2, 1, 1, 0.45)):
        planes.append(((x, y, h), (a, 0, 0), (0, b, 0)))
        planes.append(((x, y, 0), (a, 0, 0), (0, 0, h)))
        planes.append(((x, y, 0), (0, b, 0), (0, 0, h)))
    origins, u, v = (np.array([plane[i] for plane in planes], float) for i in range(3))
    area = np.linalg.norm(np.cross(u, v), axis=1)
    which = rng.choice(len(planes), num, p=area / area.sum())
    points = origins[which] + rng.random((num, 1)) * u[which] + rng.random((num, 1)) * v[which]
    return points + rng.normal(0, 0.005, points.shape)


def make_result(T: np.ndarray, **changes) -> RegistrationResult:
    cloud = CloudReport("scan.ply", 4000, 0, 0, 0, 2000, (0.0, 0.0, 0.0))
    values = {
        "T_target_source": T,
        "status": "ok",
        "reasons": (),
        "confidence": 0.9,
        "overlap": 0.6,
        "evidence": {},
        "num_correspondences": 300,
        "num_inliers": 200,
        "inlier_threshold": 0.1,
        "voxel_size": 0.05,
        "alternative": None,
        "information_matrix": np.eye(6),
        "information_center": np.zeros(3),
        "source": replace(cloud, name="source_scan.ply"),
        "target": replace(cloud, name="target_scan.ply"),
        "seconds": {"match": 0.5, "total": 1.25},
    }
    return RegistrationResult(**{**values, **changes})


def room_view(origin: np.ndarray | None = None, num: int = 4000, **changes) -> RegistrationView:
    """Two overlapping parts of the room; the source turned by 120 degrees, the target moved to ``origin``."""
    rng = np.random.default_rng(3)
    origin = np.zeros(3) if origin is None else origin
    R = Rotation.from_rotvec(np.radians(120) * np.array([0.05, 0.1, 1]) / np.linalg.norm([0.05, 0.1, 1]))
    local = make_transform(R.as_matrix(), np.array([1.0, -2.0, 0.5]))
    T = local.copy()
    T[:3, 3] += origin
    a, b = box_room(num, 1), box_room(num, 2)
    source = transform_points(inverse(local), a[a[:, 0] < 4.4])
    target = b[b[:, 0] > 1.3] + origin
    rows = rng.integers(0, len(source), 300)
    ends = transform_points(local, source[rows]) + rng.normal(0, 0.02, (300, 3)) + origin
    wrong = np.arange(300) >= 200
    ends[wrong] = target[rng.integers(0, len(target), 100)]
    fields = {
        "source_points": source,
        "target_points": target,
        "result": make_result(T),
        "correspondences": np.hstack([source[rows], ends]),
    }
    return RegistrationView(**{**fields, **changes})


def without_transform(view: RegistrationView) -> RegistrationView:
    result = replace(
        view.result, T_target_source=np.full((4, 4), np.nan), status="failed", reasons=("no hypothesis",)
    )
    return replace(view, result=result)


def nasty_view() -> RegistrationView:
    view = room_view(UTM)
    cloud = CloudReport(NASTY, 1, 0, 0, 0, 1, (0.0, 0.0, 0.0))
    half_turn, middle = np.diag([-1.0, -1, 1]), view.target_points.mean(axis=0)
    turned = make_transform(half_turn, middle - half_turn @ middle) @ view.result.T_target_source
    result = replace(
        view.result,
        source=cloud,
        target=replace(cloud, name='"><img src=x onerror=alert(1)>'),
        status="ambiguous",
        reasons=("<i>reason</i> & </script><script>alert(1)</script>",),
        alternative=Alternative(turned, 0.9, 180.0, 0.3),
    )
    return replace(
        view,
        result=result,
        groups=np.arange(300) % 2,
        group_names=("</script><script>alert(2)</script>", "<b>plain</b>"),
        source_colors=np.random.default_rng(0).random((len(view.source_points), 3)),
    )
