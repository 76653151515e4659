"""One self-contained page with a small picture of every pair, the doubtful first.

No script, no network. Some 8 kB and 50 ms per pair; beyond 2,000 pairs the surest go without a picture.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from geomoe3d.batch.folder import PAGE_MARK
from geomoe3d.batch.store import Outcome
from geomoe3d.batch.table import PairRow
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.transform_files import has_transform
from geomoe3d.errors import GeoMoE3DError
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.files import write_text
from geomoe3d.types import FloatArray
from geomoe3d.visual.scene import STATUS_WORDS, thin
from geomoe3d.visual.thumbnail import pair_thumbnail
from geomoe3d.visual.upright import upright_axes

MAX_PICTURES = 2000
_MAX_POINTS = 12_000
_WIDTH, _HEIGHT = 280, 150

_STYLE = """
:root { --paper: #fff; --panel: #f6f7f9; --ink: #1d2129; --soft: #5a6170; --line: #d9dce2;
  --good: #18794e; --doubt: #8a6100; --bad: #c02626; color-scheme: light dark; }
@media (prefers-color-scheme: dark) { :root { --paper: #16181d; --panel: #1d2026; --ink: #e8eaee;
  --soft: #a3aab8; --line: #353a44; --good: #4cc38a; --doubt: #e2a336; --bad: #ff6b6b; } }
body { margin: 0 auto; max-width: 1500px; padding: 20px; background: var(--paper); color: var(--ink);
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 20px; margin: 0 0 4px; } p { margin: 4px 0 18px; color: var(--soft); }
ol { list-style: none; margin: 0; padding: 0; display: grid; gap: 14px;
  grid-template-columns: repeat(auto-fill, minmax(296px, 1fr)); }
li { border: 1px solid var(--line); border-radius: 8px; background: var(--panel); padding: 8px;
  content-visibility: auto; contain-intrinsic-size: 296px 240px; overflow-wrap: anywhere; }
img, .blank { display: block; width: 100%; aspect-ratio: 28 / 15; object-fit: contain; }
.blank { display: grid; place-items: center; color: var(--soft); }
b { font-weight: 600; } .ok { color: var(--good); } .low_confidence, .ambiguous { color: var(--doubt); }
.failed, .error { color: var(--bad); } small { display: block; color: var(--soft); }
.source { color: #e8790c; } .target { color: #2274c4; }
"""


def save_batch_page(path: Path, rows: Sequence[PairRow], outcomes: Sequence[Outcome]) -> None:
    """Write the page; an older one is replaced.

    Args:
        path: the file to be written.
        rows: what was to be done.
        outcomes: what became of it, in the same order.

    Raises:
        OutputError: the page cannot be written.
    """
    _points.cache_clear()  # files may have changed since the last page of this process
    write_text(path, render_batch_page(rows, outcomes), force=True)


def render_batch_page(rows: Sequence[PairRow], outcomes: Sequence[Outcome]) -> str:
    """The text of the page; the same results and files give the same text."""
    order = sorted(
        range(len(rows)), key=lambda k: (outcomes[k].result is not None, outcomes[k].confidence, k)
    )
    drawn = set(order[:MAX_PICTURES])
    # Pairs of one target are drawn one after the other, so that it is read once.
    pictures = {
        k: _picture(rows[k], outcomes[k])
        for k in sorted(drawn, key=lambda k: (rows[k].target, rows[k].source))
    }
    cards = "\n".join(
        _card(rows[k], outcomes[k], pictures.get(k, "no picture: one of the surest")) for k in order
    )
    counts: dict[str, int] = {}
    for outcome in outcomes:
        counts[outcome.status] = counts.get(outcome.status, 0) + 1
    said = ", ".join(f"{count:,} {_word(status)}" for status, count in sorted(counts.items()))
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"{PAGE_MARK}\n"
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">\n"
        f"<title>{len(rows):,} pairs</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{len(rows):,} pairs</h1>\n<p>{said}. The least sure come first. Each picture shows the "
        '<span class="source">source</span> laid on the <span class="target">target</span>, from above and '
        f"from the front.</p>\n<ol>\n{cards}\n</ol>\n</body>\n</html>\n"
    )


def _card(row: PairRow, outcome: Outcome, picture: str) -> str:
    result = outcome.result
    if result is None:
        numbers, reasons = "", outcome.error or ""
    else:
        numbers = f" confidence {result.confidence:.3f}, overlap {result.overlap:.0%}"
        reasons = "; ".join(result.reasons)
    image = picture if picture.startswith("<img") else f'<div class="blank">{html.escape(picture)}</div>'
    names = f"{Path(row.source).name} → {Path(row.target).name}"
    return (
        f'<li>{image}<b class="{outcome.status}">{_word(outcome.status)}</b>{numbers}'
        f"<small>{html.escape(outcome.id)}</small><small>{html.escape(names)}</small>"
        f"<small>{html.escape(reasons)}</small></li>"
    )


def _picture(row: PairRow, outcome: Outcome) -> str:
    """An <img> of the pair, or words where there is nothing to draw."""
    if outcome.result is None or not has_transform(outcome.result):
        return "no transform"
    try:
        source, (target, axes) = _points(row.source)[0], _points(row.target)
    except GeoMoE3DError as error:
        return str(error)
    moved = transform_points(outcome.result.T_target_source, source)
    center = target.mean(axis=0)
    data = pair_thumbnail(moved - center, target - center, axes, width=_WIDTH, height=_HEIGHT)
    text = base64.b64encode(data).decode("ascii")
    name = html.escape(f"{Path(row.source).name} on {Path(row.target).name}")
    size = f'width="{_WIDTH}" height="{_HEIGHT}"'
    return f'<img loading="lazy" {size} alt="{name}" src="data:image/png;base64,{text}">'


@lru_cache(maxsize=64)
def _points(path: str) -> tuple[FloatArray, FloatArray]:
    """Some points of a file in its coordinates, and axes in which it looks upright."""
    points = load_points(path).file_points
    rng = np.random.default_rng(0)
    points = points[thin(points, _MAX_POINTS, rng)]
    return points, upright_axes(points, rng)[0]


def _word(status: str) -> str:
    return STATUS_WORDS.get(status, "not registered")
