"""The paper's tables on clouds: recall of networks that weigh correspondences, and what each of them costs.

    python scripts/paper_tables.py recall OUT NAME=WEIGHTS... [--every N] [--benchmark NAME] [--frame FRAME]
    python scripts/paper_tables.py cost OUT [--repeats 5]

recall: all pairs of the dev half of 3DMatch and 3DLoMatch (GEOMOE3D_DATA), the fixed 1,000 correspondences,
as published and with both clouds turned at random (seeded by the pair), motion by weighted SVD on the
weights alone and, unless --no-consensus, by consensus with them. WEIGHTS: a .safetensors file of any network
that scores no transforms, or none or spectral. Writes OUT/recall.md, and OUT/recall.csv with a row per pair.
Rows are compared with the first NAME pair by pair. --frame turns the clouds into a canonical frame before the
networks see them, whatever they were trained with.

cost: parameters, multiply-accumulates, time and peak memory of every network, in one run, one thread; time is
CPU time of that thread, so other work beside it does little harm. Writes OUT/cost.md.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from geomoe3d.config import FilterConfig, build_config, load_config
from geomoe3d.correspondence_registration import CorrespondenceRegistrar
from geomoe3d.data.threedmatch import BENCHMARKS, FixedCorrespondences, iterate_fixed_correspondences
from geomoe3d.evaluation.compare import mcnemar_p
from geomoe3d.evaluation.intervals import Quantity, measure_all
from geomoe3d.evaluation.metrics import is_right, motion_errors, precision_recall_f1
from geomoe3d.evaluation.records import INLIER_THRESHOLD, VOXEL_SIZE
from geomoe3d.filters.base import OutlierFilter, outlier_filter
from geomoe3d.filters.geomoe import GeoMoEFilter
from geomoe3d.filters.network import NetworkFilter
from geomoe3d.geometry.se3 import make_transform, residuals, rotation_error_deg
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.build import Network, build_network
from geomoe3d.networks.counting import count_cost, num_parameters
from geomoe3d.networks.geomoe import GeoMoE, find_neighbors
from geomoe3d.networks.pretrained import load_network
from geomoe3d.types import Correspondences, FilterOutput, FloatArray

KINDS = ("pointcn", "oanet", "umatch", "dematch", "demo", "pointdsc", "geomoe")
ESTIMATORS = ("svd", "consensus")
BANDS = ((0, 30), (30, 60), (60, 90), (90, 181))


@dataclass(frozen=True)
class Row:
    """One method on one pair."""

    benchmark: str
    frame: str
    method: str
    estimator: str
    scene: str
    pair: str
    angle: float
    right: bool
    precision: float
    recall: float
    f1: float


class Remembering(OutlierFilter):
    """A filter that answers the same question once: both estimators ask it."""

    def __init__(self, inner: OutlierFilter) -> None:
        self.inner = inner
        self._last: tuple[bytes, FilterOutput] | None = None

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """See `OutlierFilter`."""
        asked = correspondences.points.tobytes()
        if self._last is None or self._last[0] != asked:
            self._last = asked, self.inner(correspondences, voxel_size=voxel_size, seed=seed)
        return self._last[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    recall = verbs.add_parser("recall")
    recall.add_argument("out", type=Path)
    recall.add_argument("methods", nargs="+", metavar="NAME=WEIGHTS")
    recall.add_argument("--every", type=int, default=1)
    recall.add_argument("--benchmark", action="append", choices=BENCHMARKS)
    recall.add_argument("--frame", choices=("given", "principal", "hypothesis", "principal_hypothesis"))
    recall.add_argument("--no-consensus", action="store_true")
    cost = verbs.add_parser("cost")
    cost.add_argument("out", type=Path)
    cost.add_argument("--repeats", type=int, default=5)
    peak = verbs.add_parser("peak")
    peak.add_argument("kind")
    peak.add_argument("num", type=int)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.verb == "peak":
        print(peak_mib(given.kind, given.num))
        return
    given.out.mkdir(parents=True, exist_ok=True)
    if given.verb == "cost":
        write(given.out / "cost.md", cost_table(given.repeats))
        return
    filters = {}
    for text in given.methods:
        name, equals, weights = text.partition("=")
        if not equals:
            parser.error(f"'{text}' is no NAME=WEIGHTS")
        filters[name] = Remembering(open_filter(weights, given.frame))
    estimators = ESTIMATORS[:1] if given.no_consensus else ESTIMATORS
    benchmarks = given.benchmark or BENCHMARKS
    rows = [row for name in benchmarks for row in measured(name, filters, estimators, given.every)]
    with (given.out / "recall.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(asdict(rows[0])))
        table.writeheader()
        table.writerows(asdict(row) for row in rows)
    write(given.out / "recall.md", recall_tables(rows, list(filters)))


def write(path: Path, lines: Iterable[str]) -> None:
    text = "\n".join(lines) + "\n"
    path.write_text(text)
    print(text)


def open_filter(weights: str, frame: str | None) -> OutlierFilter:
    """The filter of trained weights, or of a name that needs none."""
    if weights in ("none", "spectral"):
        return outlier_filter.make(FilterConfig(name=weights))
    model, _ = load_network(weights)
    if frame is not None:
        model.config = model.config.model_copy(update={"frame": frame})
    return GeoMoEFilter(model) if isinstance(model, GeoMoE) else NetworkFilter(model)


def measured(
    benchmark: str, filters: dict[str, Remembering], estimators: tuple[str, ...], every: int
) -> Iterable[Row]:
    """Every method on every n-th pair, as published and turned."""
    solvers = {}
    for name in estimators:
        solvers[name] = CorrespondenceRegistrar(
            load_config(None, ["scoring.scorers=[surfaces]", f"estimator.name={name}"])
        )
    for index, pair in enumerate(iterate_fixed_correspondences(None, benchmark)):
        if index % every:
            continue
        label = f"{pair.source_index}-{pair.target_index}"
        angle = rotation_error_deg(pair.T_target_source, np.eye(4))
        for frame, points, T in views(pair, index):
            true = residuals(T, points[:, :3], points[:, 3:]) < INLIER_THRESHOLD
            for method, weigh in filters.items():
                for name, solver in solvers.items():
                    solver.pipeline.filter = weigh
                    found = solver(points, voxel_size=VOXEL_SIZE, inlier_threshold=INLIER_THRESHOLD, seed=0)
                    logits = found.weighed.logits
                    kept = found.weighed.weights > 0 if logits is None else logits > 0
                    answer = found.T_target_source if found.found else None
                    right = is_right(*motion_errors(answer, T))
                    yield Row(
                        benchmark, frame, method, name, pair.scene, label, angle, right,
                        *precision_recall_f1(kept, true),
                    )  # fmt: skip


def views(pair: FixedCorrespondences, index: int) -> Iterable[tuple[str, FloatArray, FloatArray]]:
    """The pair as published, and with each cloud turned by any rotation about its sensor."""
    yield "as published", pair.points, pair.T_target_source
    A, B = Rotation.random(2, random_state=index).as_matrix()
    points = np.concatenate([pair.points[:, :3] @ A.T, pair.points[:, 3:] @ B.T], axis=1)
    R, t = pair.T_target_source[:3, :3], pair.T_target_source[:3, 3]
    yield "turned", points, make_transform(B @ R @ A.T, B @ t)


def recall_tables(rows: list[Row], methods: list[str]) -> Iterable[str]:
    """One table per benchmark, estimator and frame: recall and its interval, recall by true angle, labels."""
    groups = list(dict.fromkeys((r.benchmark, r.estimator, r.frame) for r in rows))
    for group in groups:
        here = [r for r in rows if (r.benchmark, r.estimator, r.frame) == group]
        of = {m: [r for r in here if r.method == m] for m in methods}
        first = of[methods[0]]
        yield f"### {group[0]}, {group[1]}, {group[2]}: {len(first)} pairs\n"
        bands = " | ".join(f"{a}-{min(b, 180)} deg" for a, b in BANDS)
        alone = f"right alone, {methods[0]} alone, p"
        yield f"| method | recall [95 %] | {bands} | precision | recall of inliers | F1 | {alone} |"
        yield "|---|---|" + "---|" * (len(BANDS) + 4)
        for method, own in of.items():
            right = np.array([r.right for r in own])
            found = measure_all({"r": Quantity(100.0 * right, "%")}, [r.scene for r in own])["r"]
            angles = np.array([r.angle for r in own])
            cells = []
            for low, high in BANDS:
                inside = (angles >= low) & (angles < high)
                cells.append(f"{100 * right[inside].mean():.0f}" if inside.any() else "-")
            labels = [f"{np.mean([getattr(r, k) for r in own]):.3f}" for k in ("precision", "recall", "f1")]
            other = np.array([r.right for r in first])
            mine, theirs = int((right & ~other).sum()), int((other & ~right).sum())
            beside = f"{mine}, {theirs}, {mcnemar_p(mine, theirs):.2g}" if method != methods[0] else "-"
            low_end, high_end = found.interval
            value = f"{found.value:.1f} [{low_end:.1f}, {high_end:.1f}]"
            yield f"| {method} | {value} | {' | '.join([*cells, *labels])} | {beside} |"
        yield ""


def cost_table(repeats: int) -> Iterable[str]:
    """Size, multiply-accumulates, time and memory of every network with random weights."""
    columns = "network | parameters | MACs at 2,000 | all products | ms at 1,000 | ms at 2,000"
    yield f"| {columns} | peak MiB at 1,000 | at 5,000 |"
    yield "|---|---|---|---|---|---|---|---|"
    models = {kind: settled(kind) for kind in KINDS}
    times: dict[tuple[str, int], list[float]] = {}
    for _ in range(repeats):  # in turn, so that a busy moment falls on all alike
        for kind, model in models.items():
            for num in (1000, 2000):
                x = torch.randn(1, num, 6)
                neighbors = find_neighbors(x, model.config)
                begin = time.thread_time()
                with torch.no_grad():
                    model(x, None, neighbors)
                times.setdefault((kind, num), []).append(1e3 * (time.thread_time() - begin))
    for kind, model in models.items():
        cost = count_cost(model, 2000)
        ms = [f"{np.median(times[kind, num]):.0f}" for num in (1000, 2000)]
        peaks = [f"{float(child(kind, num)):.0f}" for num in (1000, 5000)]
        cells = [f"{num_parameters(model):,}", f"{cost.layers / 1e9:.3f} G", f"{cost.products / 1e9:.3f} G"]
        yield f"| {kind} | {' | '.join([*cells, *ms, *peaks])} |"


def settled(kind: str) -> Network:
    torch.manual_seed(0)
    model = build_network(build_config(NetworkConfig, {"kind": kind})).train()
    model(torch.randn(2, 300, 6))
    return model.eval()


def child(kind: str, num: int) -> str:
    """What a process of its own says of its peak memory."""
    command = [sys.executable, __file__, "peak", kind, str(num)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def peak_mib(kind: str, num: int) -> float:
    """Peak memory of one forward pass above what the process held before, MiB."""
    model = build_network(build_config(NetworkConfig, {"kind": kind})).eval()
    with torch.no_grad():
        model(torch.randn(1, 50, 6))  # what the libraries load is not the network's
    x = torch.randn(1, num, 6)
    neighbors = find_neighbors(x, model.config)
    before = highest_mib()
    with torch.no_grad():
        model(x, None, neighbors)
    return highest_mib() - before


def highest_mib() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    raise SystemExit("peak memory is read from /proc, which this system does not have")


if __name__ == "__main__":
    main()
