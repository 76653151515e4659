"""Everything that docs/benchmark.md states, measured again and written into it by one command.

    python scripts/benchmark.py [--out runs/benchmark] [--docs docs/benchmark.md] [--workers 1] [--only NAME]

Predictions lie in OUT and are not made twice: killed, it goes on; with everything predicted it only scores.
The tables replace what stands between the two marks in the document; OUT/report.html shows the rest. Peers
that are not installed are named, with what pip is to install, and left out.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from geomoe3d.cli.progress import progress_bar, stdout_to_stderr
from geomoe3d.evaluation.benchmarks import UNRELATED
from geomoe3d.evaluation.evaluation_set import EvaluationSet
from geomoe3d.evaluation.predict import MethodSpec, predict
from geomoe3d.evaluation.report_text import benchmark_tables
from geomoe3d.evaluation.score import score_runs, write_report
from geomoe3d.runtime.files import write_text

BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"
ESTIMATORS = ("geomoe", "geomoe-svd", "consensus", "spectral", "open3d-ransac-50k", "open3d-fgr", "gc-ransac")
SYSTEMS = ("geomoe3d", "kiss-matcher", "open3d-feature-ransac", "icp-identity", "small-gicp")


@dataclass(frozen=True)
class Part:
    """Methods that see the same pairs in one run."""

    name: str
    methods: tuple[str, ...]
    sets: tuple[EvaluationSet, ...]


PARTS = (
    Part("1k", ESTIMATORS, (EvaluationSet("3DMatch", "1k"), EvaluationSet("3DLoMatch", "1k"))),
    # A million samples take seconds where inliers are rare, so that search sees fewer pairs.
    Part(
        "1m",
        ("open3d-ransac-1m",),
        (EvaluationSet("3DMatch", "1k", every=8), EvaluationSet("3DLoMatch", "1k", every=8)),
    ),
    Part(
        "all",
        ("consensus",),
        (EvaluationSet("3DMatch", "all", every=8), EvaluationSet("3DLoMatch", "all", every=8)),
    ),
    Part(
        "clouds",
        SYSTEMS,
        (EvaluationSet("3DMatch", "clouds", every=4), EvaluationSet("3DLoMatch", "clouds", every=4)),
    ),
    Part(UNRELATED, ("geomoe3d",), (EvaluationSet(UNRELATED, "clouds"),)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", default="runs/benchmark", help="folder of the predictions")
    parser.add_argument("--docs", default="docs/benchmark.md", help="document with the two marks")
    parser.add_argument("--workers", type=int, default=1, help="processes over pairs")
    parser.add_argument(
        "--only", action="append", choices=sorted({part.name for part in PARTS}), help="repeatable"
    )
    parser.add_argument("--fresh", action="store_true", help="predict again")
    given = parser.parse_args()
    command = shlex.join(["python", "scripts/benchmark.py", *sys.argv[1:]])
    for part in PARTS:
        if given.only and part.name not in given.only:
            continue
        for chosen in part.sets:
            print(f"{chosen.benchmark}, track {chosen.track}: {', '.join(part.methods)}", file=sys.stderr)
            with stdout_to_stderr(), progress_bar("predictions") as advance:
                report = predict(
                    given.out,
                    [MethodSpec(name) for name in part.methods],
                    chosen,
                    workers=given.workers,
                    fresh=given.fresh,
                    command=command,
                    progress=advance,
                )
            for name, reason in report.absent.items():
                print(f"absent: {name}: {reason}", file=sys.stderr)
    runs = score_runs(given.out)
    write_report(Path(given.out) / "report.html", runs, force=True)
    write_report(Path(given.out) / "report.json", runs, force=True)
    put_tables(Path(given.docs), benchmark_tables([run.score for run in runs]))
    print(f"tables: {given.docs}; the rest: {Path(given.out) / 'report.html'}")


def put_tables(document: Path, tables: str) -> None:
    """Replace what stands between the marks."""
    text = document.read_text(encoding="utf-8")
    before, found, rest = text.partition(BEGIN)
    _, closed, after = rest.partition(END)
    if not (found and closed):
        raise SystemExit(f"'{document}' lacks the marks '{BEGIN}' and '{END}'")
    new = f"{before}{BEGIN}\n\n{tables.strip()}\n\n{END}{after}"
    write_text(document, new, force=True)


if __name__ == "__main__":
    main()
