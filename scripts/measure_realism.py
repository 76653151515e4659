"""Hold generated fragments against the real ones of the benchmark's dev half.

    python scripts/measure_realism.py GENERATED --out realism.png

GENERATED is a folder that ``geomoe3d data synthesize`` or ``data fragments`` made. Prints, per quantity,
mean and quartiles of both sides and the distance between the distributions; per overlap band the FPFH
inlier ratio, and whether its mean and quartiles lie within 20 % of the real ones. Draws one picture of two
overlaid histograms per quantity. The real side is described once and kept in ``--work``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from geomoe3d.data.describe import describe_collection
from geomoe3d.data.statistics import Statistics, by_band, distance, measure
from geomoe3d.data.threedmatch import find_benchmark_root
from geomoe3d.errors import GeoMoE3DError

_QUANTITIES = {
    "num_points": "points per fragment at 5 cm",
    "planarity": "share of points on large planes",
    "spacing": "median spacing (m)",
    "overlap": "overlap of pairs",
    "inlier_ratio": "inlier ratio (1k, 10 cm)",
    "residual": "residual of true matches (m)",
}
_TOLERANCE = 0.2


@click.command()
@click.argument("generated", type=click.Path(exists=True))
@click.option("--real", type=click.Path(exists=True), help="Default: the benchmark's dev half.")
@click.option(
    "--work", default="runs/realism", show_default=True, help="Where fragments with features are kept."
)
@click.option("--out", type=click.Path(), help="Picture to write (PNG).")
@click.option("--max-pairs", default=3000, show_default=True, help="Pairs measured per side.")
def main(generated: str, real: str | None, work: str, out: str | None, max_pairs: int) -> None:
    """Compare GENERATED fragments with real ones."""
    folder = Path(work)
    folder.mkdir(parents=True, exist_ok=True)
    mine = folder / Path(generated).resolve().name
    try:
        root = Path(real) if real else find_benchmark_root()
        describe_collection(root, folder / "real")
        describe_collection(generated, mine)
    except GeoMoE3DError as error:
        raise click.ClickException(str(error)) from None
    sides = {
        "real": measure(folder / "real", max_pairs=max_pairs),
        "generated": measure(mine, max_pairs=max_pairs),
    }
    _print_quantities(sides)
    _print_bands(sides)
    if out:
        _draw(sides, Path(out))


def _print_quantities(sides: dict[str, Statistics]) -> None:
    click.echo(f"{'quantity':34} {'side':9} {'n':>7} {'mean':>9} {'q1':>9} {'median':>9} {'q3':>9}  distance")
    for name, title in _QUANTITIES.items():
        values = {side: getattr(statistics, name) for side, statistics in sides.items()}
        for side, row in values.items():
            q1, median, q3 = np.percentile(row, [25, 50, 75])
            gap = f"  {distance(values['real'], values['generated']):.3f}" if side == "generated" else ""
            click.echo(
                f"{title:34} {side:9} {len(row):7d} {row.mean():9.4f} {q1:9.4f} {median:9.4f} {q3:9.4f}{gap}"
            )


def _print_bands(sides: dict[str, Statistics]) -> None:
    click.echo("\ninlier ratio by overlap, % (generated / real; ratio)")
    rows = {side: by_band(statistics) for side, statistics in sides.items()}
    for mine, real in zip(rows["generated"], rows["real"], strict=True):
        parts = []
        for key in ("mean", "q1", "median", "q3"):
            ratio = mine[key] / real[key] if real[key] else float("nan")
            mark = "" if abs(ratio - 1) <= _TOLERANCE else " !"
            parts.append(f"{key} {100 * mine[key]:.2f}/{100 * real[key]:.2f} ({ratio:.2f}{mark})")
        count = f"{int(mine['pairs'])}/{int(real['pairs'])} pairs"
        click.echo(f"  {mine['low']:.0%} to {mine['high']:.0%}, {count}: {', '.join(parts)}")


def _draw(sides: dict[str, Statistics], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(14, 8), layout="constrained")
    for axis, (name, title) in zip(axes.ravel(), _QUANTITIES.items(), strict=True):
        values: dict[str, Any] = {side: getattr(statistics, name) for side, statistics in sides.items()}
        joined = np.concatenate(list(values.values()))
        bins = np.linspace(joined.min(), np.percentile(joined, 99.5), 40)
        for side, row in values.items():
            axis.hist(row, bins=bins, density=True, alpha=0.5, label=f"{side} ({len(row)})")
        axis.set_title(f"{title}, distance {distance(values['real'], values['generated']):.2f}")
        axis.legend()
    figure.savefig(path, dpi=110)
    click.echo(f"picture: {path}")


if __name__ == "__main__":
    main()
