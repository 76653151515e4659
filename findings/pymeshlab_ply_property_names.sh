#!/usr/bin/env bash
# pymeshlab 2025.7.post1 (MeshLab) takes two custom vertex properties of a PLY for its own, by their names and types.
#
# Guess: an extra vertex property changes nothing about the points and colours that are read.
# Seen: an int property "flags" is read as MeshLab's internal state of a vertex: of 100 points with flags 0 to 99 half
# are gone after loading, those whose lowest bit is set, the bit of a deleted vertex. A float property "intensity"
# beside red, green and blue replaces the colours by a grey made of it. Neither is said. As doubles, both names are
# left alone. So attributes of laser scans under these names are best written as doubles.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pymeshlab==2025.7.post1 numpy
cd "$folder"
QT_QPA_PLATFORM=offscreen "$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import pymeshlab


def load(name, kind, values):
    """Points read, and their first colour, from an ASCII PLY with one extra property."""
    head = ["ply", "format ascii 1.0", "element vertex 100", *(f"property float {axis}" for axis in "xyz")]
    head += [f"property uchar {color}" for color in ("red", "green", "blue")]
    head += [f"property {kind} {name}", "end_header"]
    rows = [f"{k} {k * k % 7} {k % 3} 200 30 10 {value}" for k, value in enumerate(values)]
    with open("cloud.ply", "w") as file:
        file.write("\n".join([*head, *rows]) + "\n")
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh("cloud.ply")
    mesh = meshes.current_mesh()
    color = np.round(255 * mesh.vertex_color_matrix()[5, :3]).astype(int).tolist()
    return mesh.vertex_matrix()[:, 0].astype(int).tolist(), color


print("pymeshlab", version("pymeshlab"))
expected = {("flags", "int"): 50, ("flags", "double"): 100, ("intensity", "float"): 100, ("intensity", "double"): 100}
for (name, kind), points in expected.items():
    values = range(100) if name == "flags" else [k / 100 for k in range(100)]
    found, color = load(name, kind, values)
    print(f"{kind} {name}: wrote 100 points of colour [200, 30, 10], read {len(found)} of colour {color}")
    assert found == list(range(0, 100, 100 // points)), "the behaviour has changed"
    assert (color != [200, 30, 10]) == ((name, kind) == ("intensity", "float")), "the behaviour has changed"
PYTHON
