"""What a run writes while it goes on: CSV files, TensorBoard events, and a picture of the curves.

CSV rows of steps after the checkpoint are dropped when a run goes on, so no step appears twice.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from geomoe3d.runtime.files import write_atomically


class CsvLog:
    """A CSV file with a ``step`` column first, appended row by row, complete after every row."""

    def __init__(self, path: Path, columns: list[str], first_step: int) -> None:
        self.path = path
        self.columns = ["step", *columns]
        kept = [row for row in read_csv(path) if int(row["step"]) <= first_step] if path.exists() else []

        def write(temporary: Path) -> None:
            with temporary.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, self.columns, extrasaction="ignore", restval="")
                writer.writeheader()
                writer.writerows(kept)

        write_atomically(path, write, force=True)

    def add(self, step: int, values: dict[str, Any]) -> None:
        """One row; columns without a value stay empty."""
        row = {"step": step, **{k: f"{v:.8g}" if isinstance(v, float) else v for k, v in values.items()}}
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self.columns, restval="").writerow(row)


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV log; a last line cut short by a kill is left out."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [row for row in rows if None not in row.values() and (row.get("step") or "").isdigit()]


class TensorBoardLog:
    """Scalars for TensorBoard, or nothing where it is switched off or not installed."""

    def __init__(self, folder: Path, first_step: int, enabled: bool) -> None:
        self.missing = False
        self._writer: Any = None
        if not enabled:
            return
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            self.missing = True
            return
        self._writer = SummaryWriter(str(folder), purge_step=first_step + 1)

    def add(self, step: int, group: str, values: dict[str, Any]) -> None:
        """Scalars ``group/name``."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, step)

    def close(self) -> None:
        """Write what is buffered."""
        if self._writer is not None:
            self._writer.close()


def draw_curves(folder: Path) -> Path:
    """Draw losses, label measures, registration recall and expert balance of a run as ``curves.png``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    train = read_csv(folder / "train.csv")
    validation = read_csv(folder / "validation.csv")
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 2)

    def plot(axis: Any, rows: list[dict[str, str]], names: list[str], style: str) -> None:
        for name in names:
            points = [(int(r["step"]), float(r[name])) for r in rows if r.get(name)]
            if points:
                axis.plot(*zip(*points, strict=True), style, label=name.replace("_", " "), lw=1.2, ms=3)
        axis.set_xlabel("step")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=8)

    plot(axes[0, 0], train, ["loss", "classification", "regression"], "-")
    axes[0, 0].set_title("training losses, summed over layers")
    plot(axes[0, 1], train, ["precision", "recall", "f1"], "-")
    axes[0, 1].set_title("labels on training pairs")
    plot(axes[1, 0], validation, ["precision", "recall", "f1", "registration_recall"], "o-")
    axes[1, 0].set_title("validation")
    plot(axes[1, 1], train, ["balance", "router_entropy", "kept_fraction"], "-")
    axes[1, 1].set_title("experts: load balance (1 = even), router entropy")
    for axis in (axes[0, 1], axes[1, 0]):
        axis.set_ylim(0, 1)
    path = folder / "curves.png"
    FigureCanvasAgg(figure)
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=110), force=True)
    return path
