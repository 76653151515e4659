#!/usr/bin/env bash
# The training set, from its seed: 403 generated scenes, of which 400 hold fragments (simple solids, furniture
# models, walks through whole scene meshes) and the recorded lounge, described once for training.
#
#   scripts/training_set.sh [OUT] [WORKERS] [SCENES]
#
# OUT: default runs/training-set (ignored by git). WORKERS: default all cores. Started again, it goes on.
# Needs the models of Debian's package sweethome3d-furniture (or GEOMOE3D_MODELS), and the scene meshes and
# the lounge in GEOMOE3D_DATA (default ../shared/data).
set -euo pipefail

out=${1:-runs/training-set}
workers=${2:-$(nproc)}
scenes=${3:-403} # three walks through a scene mesh find no place for the camera
models=${GEOMOE3D_MODELS:-/usr/share/sweethome3d/furniture}
data=${GEOMOE3D_DATA:-$(cd "$(dirname "$0")/.." && pwd)/../shared/data}

for needed in "$models" "$data/scenes" "$data/rgbd/hololens-lounge"; do
  if [ ! -d "$needed" ]; then
    echo "'$needed' is not a folder; see the head of $0" >&2
    exit 2
  fi
done

meshes=()
for mesh in "$data"/scenes/*.ply; do meshes+=(--mesh "$mesh"); done

mkdir -p "$out"
geomoe3d data synthesize "$out/rooms" --scenes "$scenes" --workers "$workers" --seed 0 \
  --models "$models" "${meshes[@]}"
if [ ! -f "$out/lounge/gt_overlap.log" ]; then
  rm -rf "$out/lounge" # a rest of an interrupted run
  geomoe3d data fragments "$data/rgbd/hololens-lounge" "$out/lounge" --count 25 --grid 0.025 --voxel-size 0.012
fi
geomoe3d data features "$out/rooms" "$out/features" --workers "$workers"
geomoe3d data features "$out/lounge" "$out/features"
