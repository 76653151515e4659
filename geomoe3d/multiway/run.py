"""From scans to one model: propose pairs, register, group and align what agrees, ask again where it is loose.

Place: above registration and batch. All pairs of up to 30 scans are registered; of more, those whose scans
look alike, then, for scans and groups still apart, their next most similar, and pairs that the poses found so
far say to overlap. Pairs are kept in OUT/pairs as a batch: an interrupted or extended model reuses every one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from geomoe3d.batch.folder import read_identity
from geomoe3d.batch.memory import worker_bytes_of_any
from geomoe3d.batch.run import Labour, try_out
from geomoe3d.batch.store import BatchStore
from geomoe3d.batch.task import Settings
from geomoe3d.clouds.formats.e57 import require_pye57
from geomoe3d.config import RegistrationConfig, build_config, expert, expert_of_argument
from geomoe3d.errors import ConfigError, InputError
from geomoe3d.multiway.assembly import Assembly
from geomoe3d.multiway.defaults import ALL_PAIRS_UP_TO as ALL_PAIRS_UP_TO
from geomoe3d.multiway.defaults import MOST_ROUNDS as MOST_ROUNDS
from geomoe3d.multiway.defaults import NEIGHBORS as NEIGHBORS
from geomoe3d.multiway.faults import find_faults, forget_checks
from geomoe3d.multiway.initial import InitialPoses, read_poses
from geomoe3d.multiway.model import PAGE_FILE, SceneModel, check_folder, remove_model, write_model
from geomoe3d.multiway.pose_graph import Library, require_gtsam
from geomoe3d.multiway.report import contradicted_steps, describe_model
from geomoe3d.multiway.scans import (
    Scan,
    as_paths,
    choose_common_voxel_size,
    copies_in_words,
    find_copies,
    find_scans,
)
from geomoe3d.multiway.survey import Survey
from geomoe3d.pipeline import resolved
from geomoe3d.runtime.progress import Watch, shows_progress
from geomoe3d.runtime.timing import StageClock
from geomoe3d.runtime.words import counted

_ONCE = {"descriptor": "none", "grids": (), "max_correspondences": 0, "repeat_below": 0.0}  # no second look


@shows_progress("pairs")
@expert_of_argument
def register_scans(
    scans: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
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
    sequence: bool = False,
    initial: str | os.PathLike[str] | None = None,
    initial_error: tuple[float, float] | None = None,
    second_look: str = "none",
    optimizer: Library = "open3d",
    e57: bool = False,
    progress: Watch = None,
    say: Callable[[str], None] | None = None,
) -> SceneModel:
    """Place many scans in one model, and say which could not be placed and why.

    Called again with more scans and the same folder, all pairs of earlier calls are reused.

    Args:
        scans: files, or folders that stand for the clouds in them, at least two scans; a single folder need
            not stand in a list.
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
        fresh: forget what the folder holds of an earlier model; not before all that can be refused is known.
        sequence: the scans are given in the order in which they were taken: those that follow each other are
            registered first and are expected to overlap.
        initial: a file with a pose per scan, see `geomoe3d.multiway.initial.read_poses`; implies a sequence.
        initial_error: standard deviation of the motion between two scans that follow each other by these
            poses, cloud units, and of its angle, degrees; None: two voxels and 2 degrees.
        second_look: ``all``: doubtful pairs are looked at a second time, as `geomoe3d.register` does, at several
            times the time; ``none``.
        optimizer: the library that fits poses to pairs: ``open3d`` or, where it is installed, ``gtsam``.
        e57: write ``groupN.e57`` too: all points of all scans, each scan with its pose.
        progress: called with (pairs done, pairs in all so far proposed); None shows a bar when it takes long, False
            shows nothing.
        say: called with sentences on what begins.

    Raises:
        InputError: fewer than two usable scans, an unknown choice of pairs, more workers than fit, or a
            folder that holds pairs of another configuration, scans, or files of the user's under the names
            of the model's own.
        DependencyError: Dask or GTSAM is asked for and not installed, or a worker has other versions.
        OutputError: the folder cannot be written, or another process is writing it; or the cache is a file.
    """
    if pairs not in ("auto", "all", "similar"):
        raise InputError(f"pairs is '{pairs}'; choose auto, all or similar")
    if second_look not in ("all", "none"):
        raise InputError(f"second_look is '{second_look}'; choose all or none")
    if optimizer not in ("open3d", "gtsam"):
        raise InputError(f"optimizer is '{optimizer}'; choose open3d or gtsam")
    if optimizer == "gtsam":
        require_gtsam()
    if neighbors < 1:
        raise InputError(f"neighbors is {neighbors}, at least 1 pair per scan must be proposed")
    if initial_error is not None and not min(initial_error) > 0:
        raise InputError(f"initial_error is {initial_error}, both numbers must be positive")
    if merged_voxel_size is not None and not merged_voxel_size > 0:
        raise InputError(f"merged_voxel_size is {merged_voxel_size}, it must be positive")
    if e57:
        require_pye57()
    paths, folder = as_paths(scans), Path(out)
    labour = Labour(workers, scheduler, cache).checked()
    check_folder(folder, paths, page=page)
    say = say or (lambda text: None)
    clock = StageClock(say)
    if config is not None and config.scale != "fixed":
        raise ConfigError(f"scale: {config.scale} is for pairs; bring all scans of one model to one unit")
    found = find_scans(paths)
    stored = None if fresh else _stored_voxel_size(folder / "pairs")
    clock("look at the scans")
    given = None if initial is None else read_poses(initial, [scan.name for scan in found])
    of_old = stored is not None and (config is None or config.voxel_size is None)
    config, unusable = _with_voxel_size(resolved(config), stored, found)
    config = _of_many(config, second_look)
    poses = None
    if given is not None:
        limits = expert().many_pairs
        usual = limits.initial_shift * float(config.voxel_size or 0.0), limits.initial_turn_deg
        shift, turn = initial_error or usual
        poses = InitialPoses(given, shift, turn)
    store = BatchStore(folder / "pairs", config, fresh=fresh)
    if store.begins:
        _try_out(labour, found, Settings.of(config, labour.cache) if fresh else None)
    survey = Survey(
        found, config, store, labour, progress or None, say,
        sequence=sequence, initial=poses, optimizer=optimizer,
    )  # fmt: skip
    try:
        survey.describe(unusable)
    except InputError as error:
        if not of_old:
            raise
        raise InputError(
            f"{error}; the grid of {config.voxel_size:g} is that of the earlier model in '{folder}': where the files "
            "or their unit are others now, --fresh (fresh=True) begins anew"
        ) from None
    store.begin()
    copies = find_copies(found, store.contents.of)
    for told in copies_in_words(copies):
        say(f"note: {told}")
    if fresh:
        remove_model(folder)
        forget_checks(survey)
    clock("register pairs")
    everything = pairs == "all" or (pairs == "auto" and len(found) <= ALL_PAIRS_UP_TO)
    survey.register(survey.first_pairs(everything, neighbors))
    assembly = Assembly(survey)
    clock("group scans")
    groups = assembly.groups()
    for count in range(rounds):
        more = survey.further_pairs(groups, neighbors * 2**count, closing=count == 0)
        if not more:
            break
        clock(f"round {count + 1} of at most {rounds}: register {len(more)} further pairs")
        survey.register(more)
        clock("group scans")
        groups = assembly.groups()
    most = expert().many_pairs.map_rounds
    for count in range(min(rounds, most)):
        maps = survey.map_pairs(groups, assembly.edges)
        if not maps:
            break
        clock(
            f"local maps, round {count + 1} of at most {most}: register {counted(len(maps), 'pair')} of them"
        )
        survey.register_maps(maps, groups)
        clock("group scans")
        known, groups = groups, assembly.groups()
        if [group.poses.keys() for group in groups] == [group.poses.keys() for group in known]:
            break
    wholes = survey.whole_pairs(groups) if rounds else []
    if wholes:
        clock(f"whole groups: register {counted(len(wholes), 'pair')} of their merged models")
        survey.register_maps(wholes, groups)
        clock("group scans")
        groups = assembly.groups()
    clock("check scans that no sure pair holds")
    faults = find_faults(survey, groups, assembly.edges)
    clock("write the model")
    model = replace(describe_model(survey, assembly.edges, folder, groups, faults), copies=copies)
    if contradicted := contradicted_steps(model.edges):
        say(contradicted)
    write_model(model, merged_voxel_size, e57=e57)
    if page:
        from geomoe3d.multiway.page import save_model_page

        clock("draw the page")
        save_model_page(model, folder / PAGE_FILE)
    return replace(model, seconds=clock.stop())


def _try_out(labour: Labour, scans: list[Scan], settings: Settings | None) -> None:
    """Refuse now what the pairs would be refused for later, when much is done or, with settings, removed."""
    pool = labour.pool(worker_bytes_of_any(scan.path for scan in scans), lambda text: None)
    try:
        if settings is not None:  # a worker takes seconds to begin
            try_out(pool, settings)
    finally:
        pool.close()


def _with_voxel_size(
    config: RegistrationConfig, stored: float | None, scans: list[Scan]
) -> tuple[RegistrationConfig, dict[str, str]]:
    """The configuration with the voxel size of all scans: given, as stored with the pairs, or chosen now."""
    if config.voxel_size is not None:
        return config, {}
    unusable: dict[str, str] = {}
    size = stored
    if size is None:
        size, unusable = choose_common_voxel_size(scans, config.preparation)
    tree: dict[str, Any] = {**config.model_dump(), "voxel_size": size}
    return build_config(RegistrationConfig, tree), unusable


def _of_many(config: RegistrationConfig, second_look: str) -> RegistrationConfig:
    """The configuration of the pairs: most of many scans share nothing, so that a doubted answer is worth less."""
    tree = config.model_dump()
    tree["second_look"] |= {"mirror": False, **({} if second_look == "all" else _ONCE)}
    for part in ("confidence", "causes"):
        given = tree["expert"][part]
        given["most_doubted"] = min(given["most_doubted"], config.expert.many_groups.most_doubted)
    return build_config(RegistrationConfig, tree)


def _stored_voxel_size(folder: Path) -> float | None:
    """That of the batch in a folder, if one was begun."""
    config = (read_identity(folder) or {}).get("config")
    size = config.get("voxel_size") if isinstance(config, dict) else None
    return float(size) if isinstance(size, (int, float)) else None
