"""How good poses and homographies are: several methods on the same pairs, areas under the recall curve, intervals.

A pair of photographs goes through keypoints and matches once; every method gets these. Errors of a pose are the
larger of its rotation and translation angle, of a homography the mean distance of the image's corners. Shares
intervals and their words with the evaluation of clouds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geomoe3d.errors import FormatError, InputError
from geomoe3d.evaluation.intervals import Quantity, measure_all
from geomoe3d.evaluation.records import Measure
from geomoe3d.geometry.essential import essential_of, label_threshold, pose_errors_deg, symmetric_distance
from geomoe3d.images.cameras import Camera, ImageScene, View, opencv, relative_pose, rotation_deg
from geomoe3d.images.config import KEYPOINTS
from geomoe3d.images.features import Keypoints, Matches, detect, match, read_grey
from geomoe3d.images.homography import corner_error, find_homography, map_points
from geomoe3d.images.network import ImageNetwork
from geomoe3d.images.pose import find_pose
from geomoe3d.images.scenes import choose_pairs, images_in, read_scene
from geomoe3d.runtime.plain import plain
from geomoe3d.runtime.words import counted
from geomoe3d.types import BoolArray, FloatArray

BASELINE = "all, RANSAC"


@dataclass(frozen=True)
class Outcome:
    """One method on one pair.

    Attributes:
        scene, pair, method: names.
        error: degrees or pixels; infinite without an answer.
        status: of the answer.
        seconds: beyond keypoints and matches.
        matches: given.
        true_share: share of them that fit the truth.
        precision, recall, f1: of those that the method kept before its estimator; 0 where undefined.
        turned: rotation between the cameras, degrees; NaN for homographies.
    """

    scene: str
    pair: str
    method: str
    error: float
    status: str
    seconds: float
    matches: int
    true_share: float
    precision: float
    recall: float
    f1: float
    turned: float = math.nan


def area_under_recall(
    errors: Sequence[float] | FloatArray, limit: float, counts: FloatArray | None = None
) -> FloatArray:
    """Area under the share of errors below e, for e from 0 to ``limit``, over ``limit``; in [0, 1].

    The curve runs straight from one error to the next, as SuperGlue (Sarlin et al. 2020) and who followed have
    it. That adds half a pair's share, up to the largest error below the limit, to the area of the steps.

    Args:
        errors: (n,).
        limit: above 0.
        counts: (B, n) how often each error was drawn; None: once.

    Returns:
        (B,), NaN for no errors.
    """
    e = np.asarray(errors, dtype=np.float64)
    drawn = np.ones((1, len(e))) if counts is None else counts
    below = np.where(e < limit, e, 0.0)
    steps = drawn @ np.where(e < limit, limit - below, 0.0)
    last = np.where(drawn > 0, below, 0.0).max(axis=1, initial=0.0)
    with np.errstate(invalid="ignore"):
        area: FloatArray = (steps + last / 2) / drawn.sum(axis=1) / limit
    return area


def pose_pairs(scene: ImageScene, count: int) -> list[tuple[View, View]]:
    """``count`` pairs of a scene (fewer where there are none): half turned by 3 to 20 degrees, half by 20 to 60."""
    chosen = [
        pair for angles in ((3.0, 20.0), (20.0, 60.0)) for pair in choose_pairs(scene, angles, count // 2)
    ]
    return [(scene.views[i], scene.views[j]) for i, j in chosen]


def read_pair_list(file: Path, root: Path | None = None) -> list[tuple[View, View]]:
    """Pairs of a list as published for YFCC100M and ScanNet: a line has two names, two turns of the images
    (unused), two 3 x 3 intrinsics and a 4 x 4 pose of the second camera, row by row. Images lie in ``root``,
    else beside the list. Raises FormatError: a line has another number of words."""
    pairs = []
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
        words = line.split()
        if words and len(words) != 38:
            raise FormatError(f"'{file}' line {number} has {len(words)} words; a pair has 38")
        if words:
            values = np.array(words[4:], dtype=np.float64)
            cameras = [Camera(K[0], K[4], K[2], K[5]) for K in (values[:9], values[9:18])]
            poses = (np.eye(4), values[18:].reshape(4, 4))
            one, other = (View((root or file.parent) / words[k], cameras[k], poses[k]) for k in (0, 1))
            pairs.append((one, other))
    return pairs


def evaluate_poses(
    scene: str, pairs: Iterable[tuple[View, View]], network: ImageNetwork | None, seed: int = 0
) -> Iterator[Outcome]:
    """All methods on pairs of one scene; those with a network where one is given."""
    seen: dict[Path, Keypoints] = {}
    for views in pairs:
        for view in views:
            seen.setdefault(view.path, detect(view.path))
        found = match(*(seen[view.path] for view in views))
        cameras = (views[0].camera, views[1].camera)
        rays = np.hstack([c.normalise(found.pixels[:, 2 * k : 2 * k + 2]) for k, c in enumerate(cameras)])
        T = relative_pose(*views)
        truth = torch.from_numpy(T)
        side = max(seen[view.path].size[k] for view in views for k in (0, 1)) / max(c.focal for c in cameras)
        far = symmetric_distance(essential_of(truth), torch.from_numpy(rays))
        true = (far < label_threshold(side)).numpy()

        def error(kept: BoolArray | FloatArray, estimator: Any) -> tuple[float, str]:
            weights = kept.astype(np.float64)
            result = find_pose(found.pixels, cameras, weights=weights, estimator=estimator, seed=seed)  # noqa: B023
            if result.T is None:
                return math.inf, result.status
            return float(max(pose_errors_deg(torch.from_numpy(result.T), truth))), result.status  # noqa: B023

        pair = f"{views[0].path.stem}-{views[1].path.stem}"
        estimators = {"RANSAC": "ransac", "MAGSAC++": "magsac", "eight-point": "eight_point"}
        yield from _methods(scene, pair, found, true, rays, network, estimators, error, rotation_deg(T))


def evaluate_homographies(
    scene: str,
    cases: Iterable[tuple[str, Matches, FloatArray, tuple[int, int]]],
    network: ImageNetwork | None,
) -> Iterator[Outcome]:
    """All methods on cases of one set: name, matches, true H and size of the first image."""
    for name, found, H, size in cases:
        camera = Camera.guess(*size)
        rays = np.hstack([camera.normalise(found.pixels[:, k : k + 2]) for k in (0, 2)])
        true = np.linalg.norm(map_points(H, found.pixels[:, :2]) - found.pixels[:, 2:], axis=1) < 3.0

        def error(kept: BoolArray | FloatArray, estimator: Any) -> tuple[float, str]:
            weights = kept.astype(np.float64)
            result = find_homography(found.pixels, weights=weights, estimator=estimator)  # noqa: B023
            return corner_error(result.H, H, size), result.status  # noqa: B023

        estimators = {"RANSAC": "ransac", "MAGSAC++": "magsac", "DLT": "dlt"}
        yield from _methods(scene, name, found, true, rays, network, estimators, error)


def _methods(
    scene: str, pair: str, found: Matches, true: BoolArray, rays: FloatArray, network: ImageNetwork | None,
    estimators: dict[str, str], error: Callable[[Any, str], tuple[float, str]], turned: float = math.nan,
) -> Iterator[Outcome]:  # fmt: skip
    distinct, loose = found.distinct(), found.distinct(KEYPOINTS.loose_ratio)
    ways: list[tuple[str, str, Any, float]] = [(BASELINE, "RANSAC", np.ones(len(found), dtype=bool), 0.0)]
    ways += [(f"ratio test, {name}", name, distinct, 0.0) for name in list(estimators)[:2]]
    if network is not None:
        start = time.perf_counter()
        weights = np.maximum(np.tanh(network(rays).logits), 0.0)
        spent = time.perf_counter() - start
        kind = {"geomoe": "GeoMoE"}.get(network.model.config.kind, network.model.config.kind)
        for k, name in enumerate(estimators):  # the last one takes the weights themselves
            ways.append((f"{kind}, {name}", name, weights if k == 2 else weights > 0, spent))
            if k < 2:
                ways.append((f"{kind} and loose ratio test, {name}", name, loose & (weights > 0), spent))
    for method, estimator, kept, before in ways:
        start = time.perf_counter()
        wrong, status = error(kept, estimators[estimator])
        hit = float((true & (kept > 0)).sum())
        precision, recall = hit / max(int((kept > 0).sum()), 1), hit / max(int(true.sum()), 1)
        yield Outcome(
            scene, pair, method, wrong, status, before + time.perf_counter() - start, len(found), float(true.mean())
            if len(true) else 0.0, precision, recall, 2 * precision * recall / max(precision + recall, 1e-12), turned,
        )  # fmt: skip


def warped_cases(
    folder: Path, per_image: int = 2, seed: int = 0
) -> Iterator[tuple[str, Matches, FloatArray, Any]]:
    """Every image of a folder, reduced to 800 pixels, and exact warps of it, darkened and with noise."""
    cv2 = opencv()
    for number, path in enumerate(images_in(folder)):
        image = read_grey(path)
        scale = 800 / max(image.shape)
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        height, width = image.shape
        square = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
        first = detect(image)
        for k in range(per_image):
            rng = np.random.default_rng([seed, number, k])
            turned = np.radians(rng.uniform(-45, 45))
            R = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
            middle = np.array([width, height]) / 2
            moved = (square - middle) @ R.T * rng.uniform(0.6, 1.2) + middle
            moved = moved + rng.uniform(-0.2, 0.2, (4, 2)) * [width, height]
            H = cv2.getPerspectiveTransform(square, moved.astype(np.float32))
            other = cv2.warpPerspective(image, H, (width, height)) * rng.uniform(0.6, 1.0)
            other = np.clip(other + rng.normal(0, 4, other.shape), 0, 255).astype(np.uint8)
            yield f"{path.stem}/{k}", match(first, detect(other)), H, (width, height)


def hpatches_cases(folder: Path) -> Iterator[tuple[str, Matches, FloatArray, Any]]:
    """A sequence as HPatches publishes it: 1.ppm to 6.ppm with H_1_2 to H_1_6."""
    first = detect(folder / "1.ppm", most=4000)
    for k in range(2, 7):
        H = np.loadtxt(folder / f"H_1_{k}")
        yield f"1-{k}", match(first, detect(folder / f"{k}.ppm", most=4000)), H, first.size


def model_cases(folder: Path) -> Iterator[tuple[str, Matches, FloatArray, Any]]:
    """Pairs of danini/magsac: NAME_pts.txt (u0 v0 1 u1 v1 1) and NAME_model.txt, which maps B into A.

    Ratio and mutuality of the matches are not known: all count as distinct.
    """
    for file in sorted(folder.glob("*_model.txt")):
        name = file.name.removesuffix("_model.txt")
        rows = np.loadtxt(folder / f"{name}_pts.txt")[:, [0, 1, 3, 4]]
        image = next(path for path in images_in(folder) if path.stem == f"{name}A")
        height, width = read_grey(image).shape
        matches = Matches(rows, np.zeros(len(rows)), np.ones(len(rows), dtype=bool))
        H = np.asarray(np.linalg.inv(np.loadtxt(file)), dtype=np.float64)
        yield name, matches, H, (width, height)


def outcomes_of(
    path: Path, network: ImageNetwork | None, count: int, homographies: bool, root: Path | None = None
) -> list[Outcome]:
    """All methods on what lies at a path: a scene or a list of pairs, or one of the three kinds of homographies."""
    if homographies:
        cases = hpatches_cases if (path / "H_1_2").is_file() else model_cases
        if cases is model_cases and not any(path.glob("*_model.txt")):
            cases = warped_cases
        return list(evaluate_homographies(path.name, cases(path), network))
    pairs = read_pair_list(path, root) if path.is_file() else pose_pairs(read_scene(path), count)
    return list(evaluate_poses(path.stem, pairs, network))


def summarise(
    outcomes: Sequence[Outcome], limits: tuple[float, ...], seed: int = 0
) -> dict[str, dict[str, Measure]]:
    """Measures of every method in %, and the difference of their areas to those of `BASELINE` on the same
    pairs. Raises InputError: nothing to summarise, or methods that were not all given the same pairs."""
    by_method: dict[str, list[Outcome]] = {}
    for one in outcomes:
        by_method.setdefault(one.method, []).append(one)
    pairs = {name: [(o.scene, o.pair) for o in some] for name, some in by_method.items()}
    if len({tuple(p) for p in pairs.values()}) != 1:
        raise InputError(
            "no pairs to summarise" if not pairs else "the methods were not given the same pairs"
        )
    quantities: dict[str, Quantity] = {}
    errors = {name: np.array([o.error for o in some]) for name, some in by_method.items()}
    zero = np.zeros(len(next(iter(errors.values()))))
    for name, some in by_method.items():
        for limit in limits:
            quantities[f"{name}|auc {limit:g}"] = Quantity(zero, "points", _area(limit, errors[name]))
            if name != BASELINE and BASELINE in errors:
                statistic = _area(limit, errors[name], errors[BASELINE])
                quantities[f"{name}|gain {limit:g}"] = Quantity(zero, "points", statistic)
        for what in ("precision", "recall", "f1"):
            quantities[f"{name}|{what}"] = Quantity(100.0 * np.array([getattr(o, what) for o in some]), "%")
        ok = np.array([o.status == "ok" for o in some])
        right = errors[name] < limits[1]
        quantities[f"{name}|ok"] = Quantity(100.0 * ok, "%")
        quantities[f"{name}|right of ok"] = Quantity(np.where(ok, 100.0 * right, np.nan), "%")
        quantities[f"{name}|seconds"] = Quantity(np.array([o.seconds for o in some]), "s", 0.5)
    found = measure_all(quantities, [o.scene for o in next(iter(by_method.values()))], seed=seed)
    table: dict[str, dict[str, Measure]] = {}
    for key, measure in found.items():
        name, what = key.split("|")
        table.setdefault(name, {})[what] = measure
    return table


def _area(
    limit: float, errors: FloatArray, minus: FloatArray | None = None
) -> Callable[[FloatArray], FloatArray]:
    def statistic(counts: FloatArray) -> FloatArray:
        area = area_under_recall(errors, limit, counts)
        return 100.0 * (area if minus is None else area - area_under_recall(minus, limit, counts))

    return statistic


def to_markdown(table: dict[str, dict[str, Measure]], num: int) -> str:
    """A table of the summary: value, interval over pairs, interval over scenes."""
    columns = [what for what in next(iter(table.values())) if not what.startswith("gain")]
    lines = [f"{counted(num, 'pair')}; 95 % intervals over pairs, then over scenes; "
             f"gain: against '{BASELINE}' on the same pairs.",
             "", "| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]  # fmt: skip
    lines += [
        f"| {name} | " + " | ".join(f"{row[c].value:.2f}" for c in columns) + " |"
        for name, row in table.items()
    ]
    gains = sorted(
        {what for row in table.values() for what in row if what.startswith("gain")},
        key=lambda g: float(g[5:]),
    )
    if gains:
        lines += ["", "| | " + " | ".join(gains) + " |", "|---" * (len(gains) + 1) + "|"]
        lines += [f"| {name} | " + " | ".join(_with_intervals(row[g]) for g in gains) + " |"
                  for name, row in table.items() if gains[0] in row]  # fmt: skip
    return "\n".join(lines) + "\n"


def _with_intervals(measure: Measure) -> str:
    ends = [f"[{low:+.1f}, {high:+.1f}]" for low, high in (measure.interval, measure.scene_interval)]
    return f"{measure.value:+.2f} " + " ".join(ends)


def to_json(outcomes: Sequence[Outcome], table: dict[str, dict[str, Measure]]) -> dict[str, Any]:
    """Summary and every outcome as plain values; infinite and undefined numbers as None."""
    summary = {name: {what: asdict(m) for what, m in row.items()} for name, row in table.items()}
    return {"summary": plain(summary), "pairs": plain([asdict(one) for one in outcomes])}
