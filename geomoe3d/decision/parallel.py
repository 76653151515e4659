"""An answer turned so that walls and floors of both scans are parallel, as far as its surfaces leave that open.

Where scans share little, what they share holds the rotation loosely, and an answer that is right but for some degrees
puts the far end of a scan decimetres off. The directions of walls and floors say more: they are seen in either scan
also where the other sees nothing. Place: decide, after the answer is chosen and judged. The directions and the shared
surfaces are weighed by how far each may be off (`decision/accuracy.py`): where the surfaces hold an answer firmly, as
those of laser scans and of bodies do, nothing moves. About 10 ms.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from geomoe3d.config import expert
from geomoe3d.decision.accuracy import covariance_of
from geomoe3d.decision.distinct import are_different
from geomoe3d.decision.shared_surface import SharedSurface
from geomoe3d.geometry.se3 import cross_matrix, make_transform, motions_apart
from geomoe3d.types import FloatArray


@dataclass(frozen=True)
class Parallel:
    """Transforms of one pair as they are reported: made parallel, each once.

    Attributes:
        shared: of both clouds.
        threshold: of an inlier, cloud units.
        wanted: False leaves every transform as it is.
    """

    shared: SharedSurface
    threshold: float
    wanted: bool = True
    _known: dict[bytes, FloatArray] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __call__(self, T_target_source: FloatArray) -> FloatArray:
        """The transform (4, 4) made parallel; see `made_parallel`."""
        if not self.wanted:
            return T_target_source
        key = T_target_source.tobytes()
        if key not in self._known:
            self._known[key] = made_parallel(T_target_source, self.shared, self.threshold)
        return self._known[key]

    def differ(self, T_a: FloatArray, T_b: FloatArray) -> bool:
        """Whether two transforms (4, 4) are clearly different, as they are and made parallel; see `are_different`."""
        known, source = expert().selection, self.shared.source
        most = known.different_shift * self.threshold
        if not are_different(T_a, T_b, source, most):
            return False
        shift, turn = motions_apart(T_a, T_b, source.center)
        farther = shift > known.far_apart * most or turn > known.far_apart * known.different_turn_deg
        return not self.wanted or farther or are_different(self(T_a), self(T_b), source, most)


def made_parallel(T_target_source: FloatArray, shared: SharedSurface, threshold: float) -> FloatArray:
    """The answer (4, 4), its main directions made parallel as far as its surfaces allow; itself where they say nothing.

    Source: maximum a posteriori with the surfaces as prior; directions that stay apart count for little
    (Geman and McClure's weights).

    Args:
        T_target_source: local coordinates.
        shared: of both clouds.
        threshold: of an inlier, cloud units.
    """
    known = expert().parallel
    ours, theirs = shared.directions
    ours, theirs = paired_directions(ours @ T_target_source[:3, :3].T, with_right_angles(theirs))
    contact = shared.contact(T_target_source, threshold)
    if not len(ours) or len(contact.gaps) < expert().accuracy.least_points:
        return T_target_source
    center = contact.points.mean(0)
    radius, covariance = covariance_of(contact, center, shared.source.voxel_size)
    spread = float(np.trace(covariance))
    if not (np.isfinite(spread) and spread > 0):  # surfaces without any gap, such as a plane on itself
        return T_target_source
    prior = np.linalg.inv(covariance + 1e-12 * spread * np.eye(6))
    sigma = np.radians(known.sigma_deg)
    # A turn by w takes a direction a to a + w x a.
    J = -np.array([cross_matrix(direction) for direction in ours]) / radius
    apart = theirs - ours
    step = np.zeros(6)
    for _ in range(known.rounds):
        left = np.linalg.norm(apart - J @ step[:3], axis=1)
        weights = 1 / ((1 + (left / (known.cut * sigma)) ** 2) * sigma) ** 2
        information = prior.copy()
        information[:3, :3] += np.einsum("n,nij,nik->jk", weights, J, J)
        step = np.linalg.solve(
            information, np.append(np.einsum("n,nij,ni->j", weights, J, apart), np.zeros(3))
        )
    return _moved(T_target_source, step[:3] / radius, step[3:], center)


def with_right_angles(directions: FloatArray) -> FloatArray:
    """The directions (k, 3) and, after them, those at right angles to two that are at right angles themselves."""
    known, found = expert().parallel, list(directions)
    for one, other in combinations(directions, 2):
        third = np.cross(one, other)
        length = float(np.linalg.norm(third))
        if length > np.cos(np.radians(known.right_deg)):
            third /= length
            if all(abs(third @ direction) < np.cos(np.radians(known.reach_deg)) for direction in found):
                found.append(third)
    return np.array(found).reshape(-1, 3)


def paired_directions(ours: FloatArray, theirs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Those of ours (k, 3) that one of theirs is close to, and the closest of theirs, turned the same way."""
    if not len(ours) or not len(theirs):
        return np.zeros((0, 3)), np.zeros((0, 3))
    cosines = ours @ theirs.T
    best = np.abs(cosines).argmax(1)
    cosine = cosines[np.arange(len(ours)), best]
    close = np.abs(cosine) > np.cos(np.radians(expert().parallel.reach_deg))
    return ours[close], theirs[best[close]] * np.sign(cosine[close])[:, None]


def _moved(T: FloatArray, turn: FloatArray, shift: FloatArray, center: FloatArray) -> FloatArray:
    """The transform (4, 4) followed by a small turn (3,), radians, about a centre, and a shift."""
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(turn).as_matrix()
    moved: FloatArray = make_transform(R, center + shift - R @ center) @ T
    return moved
