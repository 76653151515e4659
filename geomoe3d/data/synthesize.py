"""``geomoe3d data synthesize``: a folder of generated scenes, in parallel, resumable, reproducible.

Scene k depends on the seed, the settings, the given material and k alone, so that any number of workers
gives the same bytes, and a larger set contains the smaller one. A scene appears in the folder complete or
not at all; a run that was killed goes on with the scenes that are not there. Memory does not grow with the
number of scenes: about 400 MB per worker.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.data.fragments import OVERLAP_GRID, relate
from geomoe3d.data.record import choose_scene, record
from geomoe3d.data.rooms.models import ModelLibrary, open_library
from geomoe3d.data.rooms.scenes import load_mesh_scene
from geomoe3d.data.settings import GENERATOR_VERSION, SynthesisSettings
from geomoe3d.data.threedmatch import write_gt_log, write_gt_overlap
from geomoe3d.errors import InputError, OutputError
from geomoe3d.runtime.files import make_folder, new_folder, refusals, write_text
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.provenance import differences, in_words
from geomoe3d.runtime.workers import ProcessPool, SerialPool, WorkerDied, run_surviving

MANIFEST = "manifest.json"
_WRITING = ".writing-"


@dataclass(frozen=True)
class Job:
    """All that a worker needs to make any scene of a set."""

    folder: str
    seed: int
    settings: SynthesisSettings
    model_folders: tuple[str, ...] = ()
    meshes: tuple[str, ...] = ()


@dataclass
class SceneSummary:
    """What one scene came to; stored as scene.json, the same for the same seed."""

    number: int
    kind: str
    name: str
    num_points: list[int] = field(default_factory=list)
    overlaps: list[float] = field(default_factory=list)
    num_pairs: int = 0
    unreadable: list[str] = field(default_factory=list)


@dataclass
class SynthesisReport:
    """What a run came to.

    Attributes:
        folder: of the set.
        made: scenes made by this run.
        kept: scenes that were there already.
        scenes: summaries of all.
        seconds: wall clock of this run.
        cpu_seconds: processor time of this run in all workers.
        unreadable: models that could not be used.
    """

    folder: Path
    made: int = 0
    kept: int = 0
    scenes: list[SceneSummary] = field(default_factory=list)
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    unreadable: list[str] = field(default_factory=list)

    @property
    def num_fragments(self) -> int:
        """Fragments of all scenes."""
        return sum(len(scene.num_points) for scene in self.scenes)

    @property
    def num_pairs(self) -> int:
        """Pairs listed for all scenes."""
        return sum(scene.num_pairs for scene in self.scenes)


def synthesize(
    folder: str | Path,
    num_scenes: int,
    *,
    seed: int = 0,
    workers: int = 1,
    settings: SynthesisSettings | None = None,
    model_folders: Sequence[str] | None = None,
    meshes: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SynthesisReport:
    """Make the scenes 0 to ``num_scenes`` - 1 that are not in the folder yet.

    Args:
        folder: is made; may hold scenes of the same seed, settings and material.
        num_scenes: size of the set.
        seed: same seed, same bytes, whatever the number of workers.
        workers: processes.
        settings: None takes the defaults.
        model_folders: furniture libraries or folders of models; None for primitives alone.
        meshes: files of whole scenes that are walked through as well.
        progress: called with (scenes there, scenes in all).

    Raises:
        InputError: the folder was made from another seed, settings or material; names what differs. Or a
            model folder or mesh is missing.
        FormatError: a mesh cannot be read.
        OutputError: the folder cannot be written, or a worker died.
    """
    if num_scenes < 1 or workers < 1:
        raise InputError(f"at least one scene and one worker are needed, found {num_scenes} and {workers}")
    if seed < 0:
        raise InputError(f"the seed must not be negative, found {seed}")
    folder = Path(folder)
    models = tuple(str(path) for path in model_folders or ())
    job = Job(str(folder), seed, settings or SynthesisSettings(), models, tuple(meshes or ()))
    missing = [path for path in job.meshes if not Path(path).is_file()]
    if missing:
        raise InputError(f"scene mesh '{missing[0]}' does not exist")
    if job.meshes and job.settings.recorder == "orbit":
        raise InputError("recorder=orbit looks at single bodies and takes no scene meshes; leave them out")
    for path in job.meshes:
        load_mesh_scene(path)  # now, not hours later, when the folder is bound to this file
    library = _open_library(job)
    _open_folder(folder, _manifest(job))
    todo = [number for number in range(num_scenes) if not (folder / scene_name(number)).is_dir()]
    report = SynthesisReport(folder, made=len(todo), kept=num_scenes - len(todo))
    started, done = time.monotonic(), report.kept
    if progress is not None:
        progress(done, num_scenes)
    for seconds in _run(job, todo, min(workers, max(len(todo), 1))):
        done += 1
        report.cpu_seconds += seconds
        if progress is not None:
            progress(done, num_scenes)
    report.seconds = time.monotonic() - started
    report.scenes = [read_summary(folder / scene_name(number)) for number in range(num_scenes)]
    listed = library.unreadable if library is not None else []
    report.unreadable = sorted({*listed, *(line for scene in report.scenes for line in scene.unreadable)})
    return report


def scene_name(number: int) -> str:
    """Name of a scene's folder."""
    return f"scene-{number:05d}"


def make_scene(job: Job, number: int) -> SceneSummary:
    """Make one scene and put it into the folder, completely or not at all. Raises OutputError: the disk
    refuses; nothing but a hidden rest is left then, which the next run removes."""
    from geomoe3d.clouds.io import save_points

    library = _open_library(job)
    before = len(library.unreadable) if library is not None else 0
    rng = np.random.default_rng([job.seed, GENERATOR_VERSION, number])
    scene = choose_scene(rng, job.settings, library, list(job.meshes))
    recorded = record(rng, scene, job.settings)
    entries, overlaps = relate(
        [cloud.astype(np.float64) for cloud in recorded.clouds],
        recorded.poses,
        job.settings.min_overlap,
        # What a camera saw at one place is compared as the benchmark does, whatever the points kept.
        job.settings.grid if job.settings.recorder == "scanner" else OVERLAP_GRID,
    )
    summary = SceneSummary(
        number,
        scene.kind,
        scene.name,
        [len(cloud) for cloud in recorded.clouds],
        [round(value, 4) for value in overlaps.values()],
        len(entries),
        sorted(set(library.unreadable[before:])) if library is not None else [],
    )
    with new_folder(Path(job.folder) / scene_name(number), "scene") as temporary:
        for k, cloud in enumerate(recorded.clouds):
            save_points(temporary / f"cloud_bin_{k}.ply", cloud)
        np.savetxt(temporary / "poses.txt", np.reshape(recorded.poses, (-1, 16)), fmt="%.17g")
        write_gt_log(temporary / "gt.log", entries, len(recorded.clouds))
        write_gt_overlap(temporary / "gt_overlap.log", overlaps)
        (temporary / "scene.json").write_text(json.dumps(asdict(summary), indent=1) + "\n")
    return summary


def read_summary(folder: Path) -> SceneSummary:
    """Summary of a scene that is there. Raises InputError: scene.json is missing or damaged; removing the
    scene's folder makes it anew."""
    try:
        return SceneSummary(**parse_json((folder / "scene.json").read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"'{folder}' is damaged ({error}); remove it and run again") from None


_LIBRARIES: dict[tuple[str, ...], ModelLibrary] = {}


def _open_library(job: Job) -> ModelLibrary | None:
    """The models of a job, listed once per process."""
    if not job.model_folders:
        return None
    if job.model_folders not in _LIBRARIES:
        _LIBRARIES[job.model_folders] = open_library(list(job.model_folders))
    return _LIBRARIES[job.model_folders]


def _timed_scene(job: Job, number: int) -> float:
    start = time.process_time()
    make_scene(job, number)
    return time.process_time() - start


def _run(job: Job, todo: list[int], workers: int) -> Iterator[float]:
    """Processor seconds of each scene as it is done."""
    pool = SerialPool() if workers == 1 else ProcessPool(workers)
    for number, made in run_surviving(pool, partial(_timed_scene, job), todo):
        if isinstance(made, WorkerDied):
            advice = "the same command goes on, with fewer --workers"
            raise OutputError(f"scene {number}: {made.reason}; {advice}")
        yield made


def _manifest(job: Job) -> dict[str, Any]:
    return {
        "generator_version": GENERATOR_VERSION,
        "seed": job.seed,
        "settings": job.settings.model_dump(mode="json"),
        "models": _fingerprint([p for folder in job.model_folders for p in sorted(Path(folder).rglob("*"))]),
        "meshes": _fingerprint([Path(path) for path in job.meshes]),
    }


def _fingerprint(paths: list[Path]) -> str:
    """Hash of names and sizes, empty for no files."""
    files = [path for path in paths if path.is_file()]
    if not files:
        return ""
    text = json.dumps([[path.name, path.stat().st_size] for path in files])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _open_folder(folder: Path, manifest: dict[str, Any]) -> None:
    """Make the folder or check that it belongs to the same set; clear what a killed run left."""
    with refusals(f"cannot write into '{folder}'"):
        make_folder(folder)
        path = folder / MANIFEST
        if path.is_file():
            try:
                found = parse_json(path.read_text())
            except ValueError as error:
                raise InputError(f"'{path}' is damaged ({error}); give a new folder") from None
            differing = differences(_completed(found), manifest)
            if differing:
                raise InputError(
                    f"'{folder}' was made with other values; give a new folder, or the same values. They differ in "
                    f"{in_words(differing)}"
                )
        elif any(folder.iterdir()):
            raise OutputError(f"'{folder}' holds files but no {MANIFEST}; give a new folder")
        else:
            write_text(path, json.dumps(manifest, indent=1) + "\n", force=False)
        for rest in folder.glob(f"{_WRITING}*"):
            shutil.rmtree(rest, ignore_errors=True)


def _completed(manifest: Any) -> dict[str, Any]:
    """A folder that names no recorder was made when there was the camera alone."""
    if isinstance(manifest, dict) and isinstance(manifest.get("settings"), dict):
        return {**manifest, "settings": {"recorder": "camera", **manifest["settings"]}}
    return manifest if isinstance(manifest, dict) else {"manifest": manifest}
