"""How often `ok` is right where most pairs do not overlap, or cannot be laid on each other at all.

    python scripts/measure_negatives.py OUT [--kind rooms --kind generated --kind world --kind mirrored]
        [--every N] [--rooms FOLDER] [--set KEY=VALUE ...]

rooms: all pairs of scans of each dev scene, most of which share nothing but the room. generated: all pairs of
generated rooms in FOLDER. world: outdoor and indoor scans of one place beside those of another. mirrored:
overlapping pairs of the dev scenes whose source is its own mirror image, where no answer is right.

`As one batch`: with confidences for the share of pairs that belong together, as `geomoe3d batch` estimates it.
Truth is used for scoring alone: an answer is right within 15 deg and 30 cm of it at the frame's origin, and never
where there is none. Lines go to OUT/KIND.jsonl as they are finished; called again, the command goes on.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from measure_multiway import dev_rooms, generated_rooms

from geomoe3d.batch.mix import beside_others, held_down, share_that_belongs
from geomoe3d.clouds.io import load_points
from geomoe3d.config import load_config
from geomoe3d.data.threedmatch import find_data_root
from geomoe3d.decision.confidence import prior_logit
from geomoe3d.evaluation.intervals import wilson
from geomoe3d.geometry.se3 import inverse, rotation_error_deg, translation_error
from geomoe3d.registration import Registrar
from geomoe3d.types import FloatArray

KINDS = ("rooms", "generated", "world", "mirrored")
_RECORDINGS = (
    "facade",
    "small_gicp",
    "lpm_cloud",
    "lpm_tutorial",
    "pcl_room",
    "nclt",
    "mulls",
    "als",
    "forest",
)
_NEAR = 3.0  # metres between sensors of a mirrored pair: near enough to see the same


class Trial(NamedTuple):
    """Two files, where they belong, and the true transform, None where there is none."""

    name: str
    group: str
    source: Path
    target: Path
    truth: FloatArray | None
    mirrored: bool = False


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--kind", "kinds", multiple=True, type=click.Choice(KINDS), help="Repeatable. [all but generated]"
)
@click.option("--every", default=1, show_default=True, help="Every so many pairs.")
@click.option("--rooms", type=click.Path(path_type=Path, exists=True), help="Generated rooms, for that kind.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="One setting; repeatable.")
def main(
    out: Path, kinds: tuple[str, ...], every: int, rooms: Path | None, settings: tuple[str, ...]
) -> None:
    """Register the pairs and print how many are ok, and how many of these are right."""
    out.mkdir(parents=True, exist_ok=True)
    registrar = Registrar(load_config(None, list(settings)))
    for kind in kinds or ("rooms", "world", "mirrored"):
        trials = list(_trials(kind, rooms))[::every]
        lines = _run(out / f"{kind}.jsonl", trials, registrar)
        groups = sorted({line["group"] for line in lines}) if kind == "rooms" else []
        for group in [*groups, kind]:
            _tell(group, [line for line in lines if group in (kind, line["group"])])


def _run(path: Path, trials: list[Trial], registrar: Registrar) -> list[dict[str, Any]]:
    done = (
        {line["name"]: line for line in map(json.loads, path.read_text().splitlines())}
        if path.exists()
        else {}
    )
    with path.open("a") as file:
        for trial in trials:
            if trial.name in done:
                continue
            source = load_points(trial.source)
            points = source.file_points * ([-1, 1, 1] if trial.mirrored else 1)
            result = registrar.register(points, str(trial.target))
            done[trial.name] = line = {
                "name": trial.name,
                "group": trial.group,
                "known": trial.truth is not None,
                "right": _is_right(result.T_target_source, trial.truth),
                "status": result.status,
                "confidence": result.confidence,
                "held": held_down(result.confidence, result.reasons, result.evidence),
            }
            file.write(json.dumps(line) + "\n")
            file.flush()
    return [done[trial.name] for trial in trials]


def _is_right(T: FloatArray, truth: FloatArray | None) -> bool:
    if truth is None or not np.isfinite(T).all():
        return False
    return bool(rotation_error_deg(T, truth) < 15 and translation_error(T, truth) < 0.3)


def _tell(group: str, lines: list[dict[str, Any]]) -> None:
    surely = [line for line in lines if line["confidence"] >= 0.95]
    share = share_that_belongs(np.array([line["confidence"] for line in lines if not line.get("held")]))
    added = prior_logit(share)
    still = [line["right"] for line in lines if beside_others(line["confidence"], added) >= 0.95]
    accepted = [line for line in lines if line["status"] == "ok"]
    right = sum(line["right"] for line in accepted)
    low, high = wilson(right / len(accepted), len(accepted)) if accepted else (0.0, 100.0)
    click.echo(
        f"{group[:44]:44s} {len(lines):5d} pairs, ok {len(accepted)}, wrong and ok {len(accepted) - right}, precision "
        f"{100 * right / max(len(accepted), 1):.1f} [{low:.1f}, {high:.1f}] %, confidence >= 0.95: "
        f"{len(surely)}, wrong {sum(not line['right'] for line in surely)}; as one batch, {100 * share:.0f} % of which "
        f"belong together: {len(still)}, wrong {len(still) - sum(still)}"
    )


def _trials(kind: str, rooms: Path | None) -> Iterator[Trial]:
    if kind in ("rooms", "mirrored"):
        yield from _room_pairs(dev_rooms([], None), mirrored=kind == "mirrored")
    elif kind == "generated":
        if rooms is None:
            raise click.UsageError("--kind generated needs --rooms FOLDER")
        yield from _room_pairs(generated_rooms(rooms, 1), mirrored=False)
    else:
        yield from _foreign_pairs()


def _room_pairs(rooms: list[Any], *, mirrored: bool) -> Iterator[Trial]:
    for room in rooms:
        files = {path.stem: path for path in room.files}
        for part in room.parts:
            for i, j in combinations(sorted(part, key=lambda stem: int(stem.rsplit("_", 1)[1])), 2):
                T = inverse(part[i]) @ part[j]  # of j into i, as the benchmark has it
                if mirrored and np.linalg.norm(T[:3, 3]) > _NEAR:
                    continue
                trial = Trial(f"{room.name}/{i}-{j}", room.name, files[j], files[i], T)
                yield trial._replace(truth=None, mirrored=True) if mirrored else trial


def _foreign_pairs() -> Iterator[Trial]:
    """Every scan of one place beside every scan of another."""
    folder = find_data_root() / "world"
    by_recording: dict[str, list[Path]] = {}
    for pair in json.loads((folder / "pairs.json").read_text()):
        name = next((n for n in _RECORDINGS if pair["name"].startswith(n)), "")
        if name:
            by_recording.setdefault(name, []).append(folder / pair["source"])
    for one, other in combinations(by_recording, 2):
        for source in by_recording[one]:
            for target in by_recording[other]:
                yield Trial(f"{source.stem}-{target.stem}", f"{one}, {other}", source, target, None)


if __name__ == "__main__":
    main()
