"""From scans to one model: propose pairs, register, group and align what agrees, ask again where it is loose.

Place: above registration and batch. All pairs of up to 30 scans are registered; of more, those whose scans
look alike, then, for scans and groups still apart, their next most similar, and pairs that the poses found so
far say to overlap. Pairs are kept in OUT/pairs as a batch: an interrupted or extended model reuses every one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from geomoe3d.batch.run import Labour
from geomoe3d.batch.store import RUN_FILE, BatchStore, remove_batch
from geomoe3d.config import RegistrationConfig, build_config
from geomoe3d.errors import InputError
from geomoe3d.filters.base import resolved
from geomoe3d.multiway.model import SceneModel, check_folder, write_model
from geomoe3d.multiway.report import describe_model
from geomoe3d.multiway.scans import Scan, choose_common_voxel_size, find_scans
from geomoe3d.multiway.survey import Survey
from geomoe3d.stages import StageClock

ALL_PAIRS_UP_TO = 30
NEIGHBORS = 10
MOST_ROUNDS = 3


def register_scans(
    scans: Iterable[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    config: RegistrationConfig | None = None,
    pairs: str = "auto",
    neighbors: int = NEIGHBORS,
    rounds: int = MOST_ROUNDS,
    merged_voxel_size: float | None = None,
    page: bool = True,
    workers: int | None = None,
    scheduler: str | None = None,
    cache: str | None = None,
    fresh: bool = False,
    progress: Callable[[int, int], None] | None = None,
    say: Callable[[str], None] | None = None,
) -> SceneModel:
    """Place many scans in one model, and say which could not be placed and why.

    Called again with more scans and the same folder, all pairs of earlier calls are reused.

    Args:
        scans: files, or folders that stand for the clouds in them; at least two.
        out: folder; made if missing. Gets ``poses.json``, per group ``groupN.tum.txt``, ``.kitti.txt``,
            ``.g2o`` and ``.ply``, ``page.html``, and the pairs as a batch in ``pairs``.
        config: of the pairs; a voxel size in it is that of all scans, None chooses one for all.
        pairs: ``all``, ``similar`` (what a cheap description of the scans proposes), or ``auto``: all for up
            to 30 scans.
        neighbors: pairs proposed per scan and round.
        rounds: how often further pairs are proposed for scans and groups that are still apart.
        merged_voxel_size: of the merged clouds, cloud units; None takes that of the registration.
        page: write a page to turn the model in.
        workers, scheduler, cache: as in `geomoe3d.register_pairs`.
        fresh: forget what the folder holds of an earlier model.
        progress: called with (pairs done, pairs in all so far proposed).
        say: called with sentences on what begins.

    Raises:
        InputError: fewer than two usable scans, an unknown choice of pairs, or a folder that holds pairs of
            another configuration, scans of this call, or files of the user's under the names of the model.
        OutputError: the folder cannot be written, or another process is writing it.
    """
    if pairs not in ("auto", "all", "similar"):
        raise InputError(f"pairs is '{pairs}'; choose auto, all or similar")
    if neighbors < 1:
        raise InputError(f"neighbors is {neighbors}, at least 1 pair per scan must be proposed")
    scans = list(scans)
    check_folder(Path(out), scans)
    say = say or (lambda text: None)
    clock = StageClock(say)
    found = find_scans(scans)
    folder = Path(out)
    if fresh:
        remove_batch(folder / "pairs")
    clock("look at the scans")
    config, unusable = _with_voxel_size(resolved(config), folder / "pairs", found)
    store = BatchStore(folder / "pairs", config)
    survey = Survey(found, config, store, Labour(workers, scheduler, cache), progress, say)
    survey.describe(unusable)
    clock("register pairs")
    survey.register(
        survey.first_pairs(pairs == "all" or (pairs == "auto" and len(found) <= ALL_PAIRS_UP_TO), neighbors)
    )
    clock("group scans")
    groups = survey.group()
    for count in range(rounds):
        more = survey.further_pairs(groups, neighbors, closing=count == 0)
        if not more:
            break
        clock("register further pairs")
        survey.register(more)
        clock("group scans")
        groups = survey.group()
    clock("write the model")
    model = describe_model(survey, folder, groups)
    write_model(model, merged_voxel_size)
    if page:
        from geomoe3d.multiway.page import save_model_page

        save_model_page(model, folder / "page.html")
    return replace(model, seconds=clock.stop())


def _with_voxel_size(
    config: RegistrationConfig, folder: Path, scans: list[Scan]
) -> tuple[RegistrationConfig, dict[str, str]]:
    """The configuration with the voxel size of all scans: given, as in the folder, or chosen now."""
    if config.voxel_size is not None:
        return config, {}
    unusable: dict[str, str] = {}
    size = _stored_voxel_size(folder / RUN_FILE)
    if size is None:
        size, unusable = choose_common_voxel_size(scans, config.preparation)
    tree: dict[str, Any] = {**config.model_dump(), "voxel_size": size}
    return build_config(RegistrationConfig, tree), unusable


def _stored_voxel_size(path: Path) -> float | None:
    try:
        size = json.loads(path.read_text(encoding="utf-8"))["identity"]["config"]["voxel_size"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return float(size) if isinstance(size, (int, float)) else None
