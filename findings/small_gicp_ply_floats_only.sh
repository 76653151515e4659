#!/usr/bin/env bash
# small_gicp 1.0.1 reads a PLY whose vertices have anything but floats as an empty cloud, without an exception.
#
# Guess: read_ply finds x, y and z whatever their type, and passes over properties that it does not need, such
# as the colours that nearly every PLY has; what it cannot read raises an exception.
# Seen: float x y z gives all points, also beside further floats. Double coordinates, or bytes red, green, blue
# beside float coordinates, give a cloud of 0 points; only stderr says "only float properties are supported".
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check small_gicp==1.0.1 "numpy>=2.0,<3"
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import small_gicp

NAMES = {"f4": "float", "f8": "double", "u1": "uchar"}
CASES = {
    "floats": ([(axis, "f4") for axis in "xyz"], 50),
    "floats and intensity": ([(name, "f4") for name in ("x", "y", "z", "intensity")], 50),
    "doubles": ([(axis, "f8") for axis in "xyz"], 0),
    "floats and colours": ([*((a, "f4") for a in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))], 0),
}
for case, (fields, expected) in CASES.items():
    rows = np.zeros(50, [(name, "<" + kind) for name, kind in fields])
    for axis in "xyz":
        rows[axis] = np.random.default_rng(ord(axis)).normal(size=50)
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 50\n"
    header += "".join(f"property {NAMES[kind]} {name}\n" for name, kind in fields) + "end_header\n"
    with open("a.ply", "wb") as file:
        file.write(header.encode() + rows.tobytes())
    found = small_gicp.read_ply("a.ply").size()
    print(f"{case}: wrote 50 points, read {found}")
    assert found == expected, "the behaviour has changed"
PYTHON
