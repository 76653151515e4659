#!/usr/bin/env bash
# small_gicp 1.0.1 and half of Open3D 0.20.0 stop every other Python thread while they work.
#
# Guess: work in C++ that takes seconds lets other threads run meanwhile, as scipy's searches do, so that clouds can be
# described or aligned side by side by a pool of threads, and a window or a server stays awake. Open3D's own ICP does.
# Seen: Open3D's registration_icp lets them run; its estimate_normals and compute_fpfh_feature do not, nor does
# anything of small_gicp (align, neighbour searches, covariances), whatever num_threads says. A thread that counts
# every millisecond counts hardly at all in between. Two threads gain nothing; what helps is the call's own
# num_threads, or processes.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    open3d-cpu==0.20.0 small_gicp==1.0.1 scipy numpy
OMP_NUM_THREADS=1 "$folder/venv/bin/python" - <<'PYTHON'
import threading
import time

import numpy as np
import open3d as o3d
import small_gicp
from scipy.spatial import cKDTree

ticks, done = [0], threading.Event()


def count():
    while not done.wait(0.001):
        ticks[0] += 1


def share(call):
    """Ticks of the other thread while the call lasts, over the milliseconds that it lasts."""
    time.sleep(0.05)
    before, start = ticks[0], time.perf_counter()
    call()
    lasted = 1000 * (time.perf_counter() - start)
    return (ticks[0] - before) / lasted, lasted


flat = np.random.default_rng(0).uniform(-1, 1, (60000, 3))
flat[:, 2] = 0.2 * np.sin(3 * flat[:, 0]) + 0.1 * np.cos(5 * flat[:, 1])
moved = flat + [0.02, 0.01, 0.0]
clouds, trees = [], []
for points in (flat, moved):
    clouds.append(small_gicp.PointCloud(points))
    trees.append(small_gicp.KdTree(clouds[-1]))
    small_gicp.estimate_normals_covariances(clouds[-1], trees[-1])
one, other = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (flat, moved))
other.estimate_normals()
reg = o3d.pipelines.registration
near = o3d.geometry.KDTreeSearchParamKNN(50)
calls = {
    "scipy cKDTree.query": lambda: cKDTree(flat).query(flat, k=20),
    "Open3D registration_icp": lambda: reg.registration_icp(
        one, other, 0.2, np.eye(4), reg.TransformationEstimationPointToPlane()
    ),
    "Open3D estimate_normals": lambda: one.estimate_normals(near),
    "Open3D compute_fpfh_feature": lambda: reg.compute_fpfh_feature(other, near),
    "small_gicp align": lambda: small_gicp.align(clouds[1], clouds[0], trees[1], max_correspondence_distance=0.2),
    "small_gicp batch_knn_search": lambda: trees[0].batch_knn_search(flat, 20),
    "small_gicp estimate_covariances": lambda: small_gicp.estimate_covariances(clouds[0], trees[0], 50),
}
thread = threading.Thread(target=count)
thread.start()
seen = {}
try:
    for name, call in calls.items():
        seen[name], lasted = share(call)
        print(f"{name}: {lasted:.0f} ms, {seen[name]:.3f} ticks per millisecond meanwhile")
finally:
    done.set()
    thread.join()
awake = {"scipy cKDTree.query", "Open3D registration_icp"}
least = min(seen[name] for name in awake)
for name, rate in seen.items():
    if name not in awake:
        assert rate < least / 5, f"{name} lets other threads run now"
assert least > 0.02, "the counting thread never ran: this machine is too busy to say"
PYTHON
echo "as described"
