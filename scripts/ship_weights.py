"""Turn the weights of a training run into those that ship with the package, in half precision.

    python scripts/ship_weights.py runs/motions [--last] [--out FILE]

Reads best.pt, or the averaged weights of last.pt, of the run folder and its config.yaml, and writes
geomoe3d/networks/weights/geomoe3d.safetensors and its card, or, to compare before shipping, FILE. Says how
far the verdicts move by the rounding.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from geomoe3d.networks.build import Network, build_network
from geomoe3d.networks.pretrained import load_network, save_pretrained
from geomoe3d.networks.weight_files import DEFAULT_WEIGHTS, PACKAGED, WeightCard
from geomoe3d.runtime.provenance import source_commit
from geomoe3d.training.batches import open_training
from geomoe3d.training.checkpoint import load_checkpoint
from geomoe3d.training.config import load_train_config
from geomoe3d.training.logs import read_csv

NOTES = (
    "GeoMoE that scores transforms; see MODEL_CARD.md beside it. Trained on generated rooms, walks "
    "through scene meshes (MIT-0) and one recorded lounge; never on 3DMatch or 3DLoMatch. docs/training.md "
    "tells of the run."
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder of geomoe3d train")
    parser.add_argument("--last", action="store_true", help="those of the last step, not of the best")
    parser.add_argument(
        "--out", type=Path, default=PACKAGED / f"{DEFAULT_WEIGHTS}.safetensors", help="file to write"
    )
    given = parser.parse_args()
    run, path = given.run, given.out
    state = load_checkpoint(run / ("last.pt" if given.last else "best.pt"))
    config = load_train_config(str(run / "config.yaml"))
    model = build_network(config.network)
    averaged = state.get("averaged")
    model.load_state_dict(averaged["model"] if given.last and averaged else state["model"])
    card = WeightCard(
        architecture={},
        voxel_size=open_training(config).voxel_sizes(),
        training_data=str(state.get("data", "")),
        steps=int(state["step"]),
        metrics=state.get("metrics", {}) if not given.last else last_metrics(run),
        commit=source_commit(),
        notes=NOTES if config.network.judges_motions else "",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    save_pretrained(path, model, card, force=True, half=True)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, step {card.steps}, {card.metrics}")
    print(f"verdicts move by up to {_moved(model.eval(), load_network(path)[0]):.4f}")


def last_metrics(run: Path) -> dict[str, float]:
    """Of the last validation, which is that of the last step."""
    row = read_csv(run / "validation.csv")[-1]
    return {name: float(value) for name, value in row.items() if name not in ("step", "best") and value}


@torch.no_grad()
def _moved(model: Network, rounded: Network) -> float:
    """Largest change of a verdict on made-up input: on motions where the network judges some, else rows."""
    torch.manual_seed(0)
    width = model.config.num_extra_channels
    channels = torch.rand(16, 500, width) ** 3 if width else None
    coordinates = torch.rand(16, 500, 6)
    first, second = (net(coordinates, channels) for net in (model, rounded))
    if first.verdict is not None and second.verdict is not None:
        return float((first.verdict - second.verdict).abs().max())
    return float((first.logits[-1] - second.logits[-1]).abs().max())


if __name__ == "__main__":
    main()
