"""Train the surface network, which scores the hypotheses of doubtful pairs.

    python scripts/train_surface_network.py OUT FOLDER... [--cut FOLDER] [--pairs 18] [--epochs 8]

FOLDER: posed fragments, generated (`scripts/training_set.sh`) or recorded, never those of a benchmark; of each 18
pairs, most of little overlap. ``--cut``: a recorded place with few pairs, of which each is cut by planes twelve times,
and drawn twice as often. Examples go to OUT/examples, one file per folder (those that are there are kept), weights to
OUT/surface_network.safetensors. About 1.2 s of one core per pair, and 5 minutes for training on 1,600.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from geomoe3d.config import RegistrationConfig
from geomoe3d.data.collection import load_fragment
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.training.surface_network import (
    Examples,
    cut,
    draw_pairs,
    examples_of,
    read_examples,
    save,
    train,
    write_examples,
)

CUTS = 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--cut", type=Path, action="append", default=[])
    parser.add_argument("--pairs", type=int, default=18)
    parser.add_argument("--epochs", type=int, default=8)
    given = parser.parse_args()
    pipeline = Pipeline(resolved(RegistrationConfig()))
    files, weights = [], []
    for folder in (*given.folders, *given.cut):
        file = given.out / "examples" / f"{folder.resolve().name}.npz"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            found = collect(pipeline, folder, given.pairs, CUTS if folder in given.cut else 0)
            write_examples(file, found)
            print(f"{folder}: {len(found)} pairs", flush=True)
        files.append(file)
        weights.append(2.0 if folder in given.cut else 1.0)
    examples = [list(read_examples([file])) for file in files]
    weight = np.concatenate([np.full(len(some), w) for some, w in zip(examples, weights, strict=True)])
    for step, steps, loss, network in train([e for some in examples for e in some], weight, given.epochs):
        print(f"step {step} of {steps}: loss {loss:.4f}", flush=True)
        save(network, given.out / "surface_network.safetensors")


def collect(pipeline: Pipeline, folder: Path, count: int, cuts: int) -> list[Examples]:
    """Examples of pairs of a folder, as they are and ``cuts`` times cut."""
    found = []
    for number, pair in enumerate(draw_pairs(folder, count if cuts == 0 else 10**6)):
        clouds = [(load_fragment(pair.source), load_fragment(pair.target))]
        clouds += [c for k in range(cuts) if (c := cut(pair, 1000 * number + k)) is not None]
        found += [
            e for both in clouds if (e := examples_of(pipeline, both, pair.T_target_source)) is not None
        ]
    return found


if __name__ == "__main__":
    main()
