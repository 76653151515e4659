#!/usr/bin/env bash
# Sets everything up, then registers a generated pair of scans: the transform on the screen, a picture and
# the files in runs/quickstart. Runs again without harm. What it installs, it names; see README.md for
# PYTHON and GEOMOE3D_TORCH_INDEX.
set -euo pipefail
# shellcheck source=scripts/environment.sh
source "$(dirname -- "${BASH_SOURCE[0]}")/environment.sh"

set_up
"$venv/bin/geomoe3d" doctor

runs="$checkout/runs/quickstart"
say "sample pair: two views of one generated room"
"$venv/bin/geomoe3d" sample "$runs" --force

say "geomoe3d register source.ply target.ply"
"$venv/bin/geomoe3d" register "$runs/source.ply" "$runs/target.ply" --force \
  --output "$runs/T_estimated.txt" --aligned "$runs/aligned.ply" --picture "$runs/registration.png"

say "the true motion, to compare"
cat "$runs/T_target_source.txt"
cat <<DONE

Picture: $runs/registration.png
Your own scans: "$venv/bin/geomoe3d" register SOURCE TARGET
DONE
