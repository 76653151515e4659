#!/usr/bin/env bash
# g2o-python 0.0.12 says that it has loaded a pose graph of which it has read nothing.
#
# Guess: SparseOptimizer.load returns whether the graph in the file is there afterwards. The file holds three poses
# (VERTEX_SE3:QUAT) and three edges (EDGE_SE3:QUAT), the types that g2o's own tools write and that every pose graph in
# space consists of.
# Seen: load returns True, prints nothing, and the optimizer has 0 vertices and 0 edges: the wheel does not register
# these types with g2o's factory, and lines of unknown types are passed over. gtsam 4.3.0 reads 3 poses and 3 factors
# from the same file. Who checks the returned value alone optimizes an empty graph; count the vertices.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check g2o-python==0.0.12 gtsam==4.3.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import g2o
import gtsam

weights = " ".join("100" if row == column else "0" for row in range(6) for column in range(row, 6))
lines = [f"VERTEX_SE3:QUAT {number} {number} 0 0 0 0 0 1" for number in range(3)]
lines += ["FIX 0"]
lines += [f"EDGE_SE3:QUAT {a} {b} {b - a} 0 0 0 0 0 1 {weights}" for a, b in ((0, 1), (1, 2), (0, 2))]
with open("graph.g2o", "w") as file:
    file.write("\n".join(lines) + "\n")

graph, poses = gtsam.readG2o("graph.g2o", True)
print(f"gtsam: {poses.size()} poses, {graph.size()} factors")
assert (poses.size(), graph.size()) == (3, 3), "gtsam reads the file otherwise now"

optimizer = g2o.SparseOptimizer()
said = optimizer.load("graph.g2o")
found = len(optimizer.vertices()), len(optimizer.edges())
print(f"g2o-python: load returned {said}; {found[0]} vertices, {found[1]} edges")
assert said and found == (0, 0), "the behaviour has changed"
PYTHON
echo "as described"
