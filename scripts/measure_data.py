"""Measure what data preparation and loading cost on one core.

    python scripts/measure_data.py generation --scenes 3 --models FOLDER --mesh FILE
    python scripts/measure_data.py memory --scenes 500 --models FOLDER --mesh FILE
    python scripts/measure_data.py loader SHARDS --pairs 400

Times are processor seconds of this process, so that other work on the machine does not count; set
OMP_NUM_THREADS=1. ``memory`` reports the resident size at every fiftieth scene and its rise per scene.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import click
import numpy as np


@click.group()
def main() -> None:
    """Costs of data preparation and loading."""


@main.command()
@click.option("--scenes", default=3, show_default=True)
@click.option("--models", multiple=True, type=click.Path(exists=True))
@click.option("--mesh", "meshes", multiple=True, type=click.Path(exists=True))
def generation(scenes: int, models: tuple[str, ...], meshes: tuple[str, ...]) -> None:
    """Seconds per generated and per described fragment."""
    from geomoe3d.data.describe import describe_collection
    from geomoe3d.data.synthesize import synthesize

    with tempfile.TemporaryDirectory() as folder:
        made = synthesize(
            Path(folder) / "rooms", scenes, model_folders=list(models), meshes=list(meshes), seed=12345
        )
        start = time.process_time()
        described = describe_collection(Path(folder) / "rooms", Path(folder) / "features")
        each = (time.process_time() - start) / max(described.num_fragments, 1)
    click.echo(f"{made.num_fragments} fragments, {made.num_pairs} pairs of {scenes} scenes")
    click.echo(f"generated: {made.cpu_seconds / max(made.num_fragments, 1):.2f} s of one core per fragment")
    click.echo(f"described: {each:.3f} s of one core per fragment")


@main.command()
@click.option("--scenes", default=500, show_default=True)
@click.option("--models", multiple=True, type=click.Path(exists=True))
@click.option("--mesh", "meshes", multiple=True, type=click.Path(exists=True))
def memory(scenes: int, models: tuple[str, ...], meshes: tuple[str, ...]) -> None:
    """Resident memory of one process over many scenes; full scenes, two short fragments each."""
    from geomoe3d.data.settings import SynthesisSettings
    from geomoe3d.data.synthesize import synthesize

    sizes: list[float] = []

    def note(done: int, total: int) -> None:
        sizes.append(_resident_mb())
        if done in (0, 1, total) or done % 50 == 0:
            click.echo(f"after {done:4d} scenes: {sizes[-1]:.0f} MB, largest {max(sizes):.0f} MB")

    start = time.process_time()
    settings = SynthesisSettings(fragments_per_scene=2, frames_per_fragment=2, min_points=500)
    with tempfile.TemporaryDirectory() as folder:
        synthesize(
            Path(folder) / "rooms",
            scenes,
            settings=settings,
            model_folders=list(models),
            meshes=list(meshes),
            progress=note,
        )
    half = np.array(sizes[len(sizes) // 2 :])
    rise = np.polyfit(np.arange(len(half)), half, 1)[0] if len(half) > 2 else float("nan")
    used = time.process_time() - start
    click.echo(f"{rise:+.3f} MB per scene over the second half; {used:.0f} s of one core")


def _resident_mb() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return float(line.split()[1]) / 1024
    return float("nan")


@main.command()
@click.argument("shards", type=click.Path(exists=True))
@click.option("--pairs", default=400, show_default=True)
def loader(shards: str, pairs: int) -> None:
    """Training pairs of 1,000 correspondences per second, drawn alone and as augmented network input."""
    import torch

    from geomoe3d.data.draw import DrawSettings
    from geomoe3d.training.batches import TrainingSamples
    from geomoe3d.training.config import TrainConfig
    from geomoe3d.training.fragment_pairs import FragmentPairs

    torch.set_num_threads(1)
    data = FragmentPairs(shards, DrawSettings(usual_share=1.0))
    samples = TrainingSamples(data, TrainConfig())
    for title, source in (("drawn", data), ("drawn, augmented, as network input", samples)):
        start, wall = time.process_time(), time.monotonic()
        for k in range(pairs):
            _ = source[k]
        used, passed = time.process_time() - start, time.monotonic() - wall
        click.echo(
            f"{title}: {pairs / used:.0f} pairs per second of one core ({pairs / passed:.0f} by the clock)"
        )


if __name__ == "__main__":
    main()
