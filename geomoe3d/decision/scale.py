"""Whether two clouds are of one size: a similarity fitted to their surfaces, starting at the rigid answer.

Place: after decide. A rigid motion hides a difference of scale in its residuals, and where that is a few per cent
the clouds still lie on each other well enough to be believed. Scans are no rigid bodies either: what a depth
camera fuses is bent by a per cent or two. So the ratio is given with an uncertainty that is read from the same
surfaces: how differently they stretch along different directions, which no scale explains. The first rounds ask few
points, the last ones all, until they change nothing: about 10 ms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomoe3d.config import expert
from geomoe3d.decision.shared_surface import SharedSurface, distortion_of, robust_weights, solved
from geomoe3d.geometry.columns import crossed
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.types import FloatArray

DIFFERS = "the scale differs"
UNITS_DIFFER = "units differ"
_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048, "metres": 1.0}


@dataclass(frozen=True)
class Scale:
    """How large the source is beside the target.

    Attributes:
        ratio: lengths of the source over those of the target; 1.1: the source is ten per cent too large.
        sigma: one standard deviation of the natural logarithm of the ratio.
    """

    ratio: float
    sigma: float

    @property
    def differs(self) -> bool:
        """Whether the ratio is off 1 by more than one per cent and by more standard deviations than chance gives: 3.5
        below 3.5 per cent, by which fragments of one camera differ, else 2.6, and 1.3 beyond five per cent where the
        deviation is under eight."""
        off, known = abs(float(np.log(self.ratio))), expert().scale
        enough = known.significant
        if off < known.usual:
            enough = known.significant_usual
        elif off > known.unheard_of and self.sigma < known.firm:
            enough /= 2
        return off > max(enough * self.sigma, known.tolerated)

    def exchanged(self) -> Scale:
        """The same of the target beside the source."""
        return replace(self, ratio=1 / self.ratio)

    def sentence(self, source: str, target: str) -> str:
        """What a user is told where it `differs`, with the names of both clouds: roles may be exchanged later."""
        names = told_apart(source, target, self.ratio)
        text = (
            f"{DIFFERS}: lengths in {names[0]} are {self.ratio:.4g} times those in {names[1]} "
            f"(+- {100 * self.sigma:.1f} %), and a rigid transform cannot change scale"
        )
        return text + seeming_units(self.ratio, names)


def measure_scale(T_target_source: FloatArray, shared: SharedSurface) -> Scale | None:
    """The ratio of lengths by which two surfaces lie on each other best, near a rigid answer.

    Point-to-plane in both directions, each with the normals of the cloud that is asked, about the centre of what
    is shared; nearest neighbours are sought anew in every round.

    Args:
        T_target_source: (4, 4) the answer, local coordinates.
        shared: of both clouds.

    Returns:
        None where too few points lie on each other, or the fit runs away.
    """
    fit = _Fit(T_target_source, shared)
    known = expert().scale
    begun = len(known.reaches) - known.thorough_rounds
    near = False
    for number, reach in enumerate(known.reaches):
        few = number < begun
        if few and near:
            continue
        growth = fit.step(reach * shared.source.voxel_size, few=few)
        if growth is None:
            return None
        near = abs(growth) < known.nearly_settled
        if not few and abs(growth) < known.settled:
            break
    return Scale(float(1 / fit.scale), fit.deviation())


class _Fit:
    """p_target = scale R p_source + t, improved step by step."""

    def __init__(self, T: FloatArray, shared: SharedSurface) -> None:
        self.scale, self._R, self._t = 1.0, T[:3, :3], T[:3, 3]
        self._shared, self._voxel = shared, shared.source.voxel_size

    def step(self, reach: float, *, few: bool = False) -> float | None:
        """One linear solution; by how much the scale grew, None where too little matches or it leaves what is sought.

        ``few``: of few points, of which a quarter as many must match.
        """
        from scipy.spatial.transform import Rotation

        contact = self._shared.contact(make_transform(self._R, self._t), reach, self.scale, few=few)
        points, normals, gaps = contact.points, contact.normals, contact.gaps
        least = expert().scale.least_points
        if len(points) < (least // 2 if few else 2 * least):
            return None
        weights = robust_weights(gaps, self._voxel)
        center = points.mean(0)
        self._radius = float(np.sqrt(np.mean(np.sum((points - center) ** 2, axis=1))))
        self._rows = (points - center) / self._radius, normals, gaps, weights
        X = self._rows[0]
        J = np.hstack([crossed(X, normals), normals, np.einsum("ij,ij->i", X, normals)[:, None]])
        x, self._inverse, self._variance = solved(J, gaps, weights)
        growth, turn = 1 + x[6] / self._radius, Rotation.from_rotvec(x[:3] / self._radius).as_matrix()
        self._t = center + growth * turn @ (self._t - center) + x[3:6]
        self._R, self.scale = turn @ self._R, self.scale * growth
        known = expert().scale
        return x[6] / self._radius if known.smallest < self.scale < known.largest else None

    def deviation(self) -> float:
        """One standard deviation of ln(scale), from the distortion that is left and from the fit."""
        distortion = distortion_of(*self._rows, self._radius)
        formal = float(np.sqrt(self._variance * self._inverse[6, 6])) / self._radius
        known = expert().scale
        return float(np.hypot(known.per_distortion * distortion, known.per_formal * formal))


def told_apart(source: str, target: str, ratio: float) -> tuple[str, str]:
    """Names of two clouds as messages write them; of one name, by which has the larger lengths."""
    if source != target:
        return f"'{source}'", f"'{target}'"
    this, other = ("larger", "smaller") if ratio > 1 else ("smaller", "larger")
    return f"'{source}' (the {this} one)", f"'{target}' (the {other} one)"


def seeming_units(ratio: float, names: tuple[str, str]) -> str:
    """An end of a sentence that names the two units in which one body gives this ratio of lengths, to 2 %; else
    empty. Feet are international or US survey ones, which differ by two millionths."""
    for (source, target), expected in _unit_ratios().items():
        if abs(np.log(ratio / expected)) < expert().scale.unit_tolerance:
            return f"; {names[0]} seems to be in {source}, {names[1]} in {target}"
    return ""


def units_differ(ratio: float, source: str, target: str) -> str:
    """A sentence for two clouds, by name, that fit once all lengths of the first are divided by the ratio."""
    if ratio < 1:  # the larger one is named first, whichever is asked about
        ratio, source, target = 1 / ratio, target, source
    names = told_apart(source, target, ratio)
    units = seeming_units(ratio, names)
    return (
        f"{UNITS_DIFFER}: lengths in {names[0]} are {ratio:.6g} times those in {names[1]}, and once that is taken into "
        f"account the clouds fit{units}; bring both to one unit, a rigid transform cannot change scale"
    )


def ratios_to_metres() -> tuple[float, ...]:
    """Lengths of one cloud over those of another where just one of them is in metres, likelier units first."""
    ratios = [_UNITS["metres"] / _UNITS[name] for name in ("feet", "millimetres", "centimetres", "inches")]
    return tuple(value for ratio in ratios for value in (ratio, 1 / ratio))


def likely_unit_ratio(extents: tuple[float, float]) -> float | None:
    """The ratio of units nearest to that of two extents (source, target), None where none is within 1.5."""
    if min(extents) <= 0:
        return None
    found = np.log(extents[0] / extents[1])
    nearest = min(_unit_ratios().values(), key=lambda ratio: abs(np.log(ratio) - found))
    return nearest if abs(np.log(nearest) - found) < np.log(expert().scale.extent_tolerance) else None


def _unit_ratios() -> dict[tuple[str, str], float]:
    """Lengths of the source over those of the target for every two different units."""
    return {(s, t): _UNITS[t] / _UNITS[s] for s in _UNITS for t in _UNITS if s != t}
