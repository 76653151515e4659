"""A page of every pair of a batch, in which its clouds can be turned; written on request, a second each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geomoe3d.batch.folder import files_in, is_own_page, page_name, pair_mark
from geomoe3d.batch.store import Outcome
from geomoe3d.batch.table import PairRow
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.transform_files import has_transform
from geomoe3d.errors import GeoMoE3DError, OutputError
from geomoe3d.runtime.files import make_folder, remove, write_text
from geomoe3d.runtime.progress import Watch, shows_progress
from geomoe3d.visual.page import render_page
from geomoe3d.visual.view import RegistrationView


@shows_progress("pages")
def write_pages(
    folder: Path, rows: Sequence[PairRow], outcomes: Sequence[Outcome], *, progress: Watch = None
) -> None:
    """One page per pair that has a transform; those that an earlier call wrote of other pairs are removed.

    Correspondences are not kept in a batch, so these pages show none. A pair whose files can no longer be read
    has no page.

    Args:
        folder: made if missing.
        rows: what was to be done.
        outcomes: what became of it, in the same order.
        progress: told of pages done.

    Raises:
        OutputError: a file cannot be written or removed.
    """
    make_folder(folder)
    written = set()
    for done, (row, outcome) in enumerate(zip(rows, outcomes, strict=True)):
        if progress:
            progress(done, len(rows))
        result = outcome.result
        if result is None or not has_transform(result):
            continue
        try:
            clouds = load_points(row.source, seed=result.seed), load_points(row.target, seed=result.seed)
            view = RegistrationView.of(result, clouds, np.zeros((0, 6)))
            path = folder / page_name(row.id)
            write_text(path, render_page(view, mark=pair_mark(row.id)), force=True)
        except OutputError:
            raise
        except GeoMoE3DError:
            continue
        written.add(path.name)
    remove([path for path in files_in(folder) if path.name not in written and is_own_page(path)])
    if progress:
        progress(len(rows), len(rows))
