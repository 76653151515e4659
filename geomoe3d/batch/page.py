"""One self-contained page with a small picture of every pair, the doubtful first.

A small script sorts and filters; no network. Some 8 kB and 50 ms per pair; beyond 2,000 pairs the surest go
without a picture.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from geomoe3d.batch.folder import PAGE_MARK, PAGES_FOLDER, files_in, is_own_page, page_name
from geomoe3d.batch.store import Outcome
from geomoe3d.batch.table import PairRow
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.transform_files import has_transform
from geomoe3d.errors import GeoMoE3DError
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.files import write_text
from geomoe3d.runtime.progress import Watch, shows_progress
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray
from geomoe3d.visual.drawing import STATUS_WORDS, thin
from geomoe3d.visual.templates import render
from geomoe3d.visual.thumbnail import pair_thumbnail
from geomoe3d.visual.upright import upright_axes

_UNDRAWN = "no picture: one of the surest"


@shows_progress("pictures")
def save_batch_page(
    path: Path, rows: Sequence[PairRow], outcomes: Sequence[Outcome], *, progress: Watch = None
) -> None:
    """Write the page; an older one is replaced.

    Args:
        path: the file to be written.
        rows: what was to be done.
        outcomes: what became of it, in the same order.
        progress: told of pictures drawn.

    Raises:
        OutputError: the page cannot be written.
    """
    _points.cache_clear()  # files may have changed since the last page of this process
    pages = {path.name for path in files_in(path.parent / PAGES_FOLDER) if is_own_page(path)}
    write_text(path, render_batch_page(rows, outcomes, pages, progress), force=True)


def render_batch_page(
    rows: Sequence[PairRow],
    outcomes: Sequence[Outcome],
    pages: AbstractSet[str] = frozenset(),
    progress: Watch = None,
) -> str:
    """The text of the page; the same results and files give the same text.

    Args:
        rows, outcomes: as for `save_batch_page`.
        pages: names of the files in ``pages`` that the pairs are linked to.
        progress: told of pictures drawn.
    """
    order = sorted(
        range(len(rows)), key=lambda k: (outcomes[k].result is not None, outcomes[k].confidence, k)
    )
    drawn = set(order[:2000])  # pictures: more make a page that browsers are slow with
    # Pairs of one target are drawn one after the other, so that it is read once.
    pictures: dict[int, tuple[str, str]] = {}
    for k in sorted(drawn, key=lambda k: (rows[k].target, rows[k].source)):
        if progress:
            progress(len(pictures), len(drawn))
        pictures[k] = _picture(rows[k], outcomes[k])
    if progress:
        progress(len(pictures), len(drawn))
    counts = Counter(outcome.status for outcome in outcomes)
    return render(
        "batch/page.html",
        generator=Markup(PAGE_MARK),
        title=counted(len(rows), "pair"),
        counts=", ".join(f"{count:,} {_word(status)}" for status, count in sorted(counts.items())),
        statuses=[(status, count, _word(status)) for status, count in sorted(counts.items())],
        cards=[_card(rows[k], outcomes[k], *pictures.get(k, ("", _UNDRAWN)), pages) for k in order],
    )


def _card(row: PairRow, outcome: Outcome, image: str, blank: str, pages: AbstractSet[str]) -> dict[str, Any]:
    result = outcome.result
    page = page_name(row.id)
    return {
        "page": f"{PAGES_FOLDER}/{quote(page)}" if page in pages else "",
        "confidence": repr(float(outcome.confidence)),
        "overlap": repr(float(result.overlap)) if result and np.isfinite(result.overlap) else "0",
        "image": image,
        "blank": blank,
        "status": outcome.status,
        "word": _word(outcome.status),
        "numbers": f" confidence {result.confidence:.3f}, overlap {100 * result.overlap:.0f} %"
        if result
        else "",
        "id": outcome.id,
        "source": Path(row.source).name,
        "target": Path(row.target).name,
        "reasons": "; ".join(result.reasons) if result else outcome.error or "",
    }


def _picture(row: PairRow, outcome: Outcome) -> tuple[str, str]:
    """A PNG in base64, or words where there is nothing to draw."""
    if outcome.result is None or not has_transform(outcome.result):
        return "", "no transform"
    try:
        source, (target, axes) = _points(row.source)[0], _points(row.target)
    except GeoMoE3DError as error:
        return "", str(error)
    moved = transform_points(outcome.result.T_target_source, source)
    center = target.mean(axis=0)
    data = pair_thumbnail(moved - center, target - center, axes)
    return base64.b64encode(data).decode("ascii"), ""


@lru_cache(maxsize=64)
def _points(path: str) -> tuple[FloatArray, FloatArray]:
    """Some points of a file in its coordinates, and axes in which it looks upright."""
    points = load_points(path).file_points
    rng = np.random.default_rng(0)
    points = points[thin(points, 12_000, rng)]
    return points, upright_axes(points, rng)[0]


def _word(status: str) -> str:
    return STATUS_WORDS.get(status, "not registered")
