#!/usr/bin/env bash
# plyfile 1.1.5 writes a PLY with byte_order=">" wrongly where the element has a list property.
#
# Guess: every value is written in the byte order that the header names, with list properties as without.
# Seen: without lists it is. With a list, the scalar properties of the same element stay in the order of the
# machine, the header says binary_big_endian all the same, and neither writing nor reading back complains: 1.0
# comes back as 3.03865e-319. So a big-endian PLY with lists of plyfile's making must not be taken for a test
# of a reader. Seen on x86-64 with numpy 2.4.6.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check plyfile==1.1.5 "numpy>=2.0,<3"
"$folder/venv/bin/python" - <<'PYTHON'
import io

import numpy as np
import plyfile

rows = np.empty(3, [("x", "f8"), ("views", object)])
rows["x"] = [1.0, 2.0, 3.0]
rows["views"] = [np.arange(k + 1, dtype="i4") for k in range(3)]
for has_list in (False, True):
    table = rows if has_list else np.array([(x,) for x in rows["x"]], [("x", "f8")])
    for order in "<>":
        file = io.BytesIO()
        plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")], byte_order=order).write(file)
        read = plyfile.PlyData.read(io.BytesIO(file.getvalue()))["vertex"]["x"].tolist()
        print(f"list {has_list}, order {order}: wrote [1.0, 2.0, 3.0], read {read}")
        wrong = has_list and order == ">"
        assert (read != [1.0, 2.0, 3.0]) == wrong, "the behaviour has changed"
PYTHON
