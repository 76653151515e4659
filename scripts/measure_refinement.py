"""How close ICP and GICP come to the truth from a start two degrees and five centimetres off.

    python scripts/measure_refinement.py

Generated sample pairs with exact truth, on 5 cm voxel points; the error of position is the mean over the
source's points.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.prepare import prepare
from geomoe3d.clouds.viewpoint import find_viewpoints
from geomoe3d.config import PreparationConfig, RefinementConfig
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg, shift_frames, transform_points
from geomoe3d.refinement.icp import CloudAligner

VOXEL_SIZE = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.parse_args()
    turn = Rotation.from_rotvec(np.radians(2) * np.array([0.6, -0.5, 0.62])).as_matrix()
    disturbance = make_transform(turn, np.array([0.03, -0.02, 0.03]))
    print("| pair | method | reach (voxels) | rotation error | position error | time |")
    print("|---|---|---|---|---|---|")
    for seed in range(3):
        source, target, T_files = make_sample_pair(seed=seed)
        truth = shift_frames(T_files, -source.origin, -target.origin)
        views = find_viewpoints(source, target, "auto")
        clouds = [
            prepare(cloud, VOXEL_SIZE, PreparationConfig(), viewpoint=view)
            for cloud, view in zip((source, target), views, strict=True)
        ]
        for method in ("icp", "gicp"):
            for reach in (2.0, 1.5, 1.0):
                config = RefinementConfig.model_validate({"name": method, "max_distance": reach})
                begin = time.perf_counter()
                T, _ = CloudAligner(clouds[0], clouds[1], config)(truth @ disturbance)
                seconds = time.perf_counter() - begin
                apart = transform_points(T, source.points) - transform_points(truth, source.points)
                print(
                    f"| {seed} | {method} | {reach} | {rotation_error_deg(T, truth):.3f} deg | "
                    f"{1000 * np.linalg.norm(apart, axis=1).mean():.1f} mm | {1000 * seconds:.0f} ms |"
                )


if __name__ == "__main__":
    main()
