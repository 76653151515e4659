"""What a generated set holds, in words and numbers, for the person who made it."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np

from geomoe3d.data.statistics import BANDS
from geomoe3d.data.synthesize import SynthesisReport
from geomoe3d.runtime.files import write_text
from geomoe3d.runtime.words import counted


def report_text(report: SynthesisReport) -> str:
    """Markdown: scenes by kind, fragments, pairs by overlap, points, unreadable models, cost of this run."""
    kinds = Counter(scene.kind for scene in report.scenes)
    rooms = Counter(name for scene in report.scenes for name in scene.name.split("+"))
    points = np.array([count for scene in report.scenes for count in scene.num_points] or [0])
    overlaps = np.array([value for scene in report.scenes for value in scene.overlaps] or [0.0])
    q = np.percentile(points, [5, 25, 50, 75, 95]).round().astype(int).tolist()
    lines = [
        f"# {report.folder.name}",
        "",
        f"- scenes: {len(report.scenes)} ({', '.join(f'{n} {kind}' for kind, n in kinds.most_common())})",
        f"- rooms: {', '.join(f'{n} {name}' for name, n in rooms.most_common())}",
        f"- fragments: {report.num_fragments}; points 5/25/50/75/95 %: {q}",
        f"- pairs in gt.log: {report.num_pairs}",
    ]
    for low, high in pairwise((0.0, *BANDS)):
        count = int(((overlaps >= low) & (overlaps < high)).sum())
        lines.append(f"  - overlap {100 * low:.0f} % to {100 * min(high, 1):.0f} %: {counted(count, 'pair')}")
    few = [str(scene.number) for scene in report.scenes if scene.num_pairs == 0]
    if few:
        lines.append(f"- scenes without a pair: {', '.join(few)}")
    for line in report.unreadable:
        lines.append(f"- unreadable model: {line}")
    if report.made:
        new = [len(scene.num_points) for scene in report.scenes]
        each = report.cpu_seconds / max(1.0, sum(new) * report.made / len(new))
        lines.append(
            f"- this run: {counted(report.made, 'scene')} made, {report.kept} kept, {report.seconds:.0f} s, "
            f"about {each:.2f} s of one core per fragment"
        )
    return "\n".join(lines) + "\n"


def write_report(report: SynthesisReport, path: Path) -> None:
    """Write report.md, replacing that of an earlier run. Raises OutputError: the disk refuses."""
    write_text(path, report_text(report), force=True)
