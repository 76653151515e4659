"""Make docs/images/registration.png, the picture of the README: two generated scans before and after.

    python scripts/first_picture.py [FILE]

Under 200 kB, a few seconds, the same bytes for the same versions of the libraries.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

import numpy as np

import geomoe3d
from geomoe3d.data.sample import write_sample_pair
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.visual.drawing import build_drawing
from geomoe3d.visual.paper import INK, SOFT, bounds, frame, show
from geomoe3d.visual.xray import xray

INCHES = (10.0, 4.6)
DPI = 100
COLORS = 40  # keep the file small


def main(path: Path) -> None:
    from matplotlib.figure import Figure
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        paths = write_sample_pair(Path(folder))
        made = geomoe3d.Registrar().explain(paths.source, paths.target)
    result, drawing = made.result, build_drawing(made.view(), max_points=60_000)
    if drawing.after is None:
        raise SystemExit("no transform was found: nothing to show")
    stages = {"before": drawing.before, "after": drawing.after}
    target = drawing.target @ drawing.axes.T
    sources = {name: transform_points(T, drawing.source) @ drawing.axes.T for name, T in stages.items()}
    low, high = bounds(np.concatenate(list(sources.values())), target)
    figure = Figure(figsize=INCHES, dpi=DPI, facecolor="white")
    for number, (name, source) in enumerate(sources.items()):
        panel = figure.add_axes((0.01 + 0.5 * number, 0.02, 0.48, 0.84))
        frame(panel)
        size = panel.get_window_extent()
        unit = 1.04 * max((high - low)[0] / size.width, (high - low)[1] / size.height)
        half, center = np.array([size.width, size.height]) * unit / 2, ((low + high) / 2)[:2]
        image = xray(source[:, :2], target[:, :2], center, half, unit, drawing.spacing)
        show(panel, image, center, half)
        panel.set_title(name, loc="left", fontsize=11, color=SOFT)
    words = f"{result.status}, confidence {result.confidence:.2f}"
    figure.text(0.5, 0.95, words, ha="center", fontsize=13, fontweight="bold", color=INK)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    Image.open(drawn).convert("RGB").quantize(COLORS).save(path, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images/registration.png"))
