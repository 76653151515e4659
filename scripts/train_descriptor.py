"""Train the learned descriptor on fragments with features.

    python scripts/train_descriptor.py runs/descriptor [KEY=VALUE...]

The folder gets the configuration, a log, checkpoints and at the end learned.safetensors; the same command
goes on where it was interrupted. Keys: `geomoe3d.training.descriptor.DescriptorTrainConfig`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from geomoe3d.config import build_config, set_keys
from geomoe3d.training.descriptor import DescriptorRun, DescriptorTrainConfig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the run")
    parser.add_argument("assignments", nargs="*", metavar="KEY=VALUE")
    given = parser.parse_args()
    config = build_config(DescriptorTrainConfig, set_keys({}, given.assignments))
    print(f"weights: {DescriptorRun(config, given.folder).train()}")


if __name__ == "__main__":
    main()
