#!/usr/bin/env bash
# What the network that judges motions trains on: rooms, laser scans and single bodies on grids of 3 to 20 cm, each
# pair with the motions that consensus proposes.
#
#   scripts/wider_set.sh [SET] [OUT] [WORKERS]
#
# SET: what scripts/training_set.sh made, default runs/training-set; gets scans, bodies and further descriptions.
# OUT: default runs/wider-motions, a folder per part; give it as data.train. Started again, it goes on.
# Needs the models of Debian's package sweethome3d-furniture (or GEOMOE3D_MODELS).
set -euo pipefail

set=${1:-runs/training-set}
out=${2:-runs/wider-motions}
workers=${3:-$(nproc)}
models=${GEOMOE3D_MODELS:-/usr/share/sweethome3d/furniture}

if ! command -v geomoe3d >/dev/null; then
  echo "no geomoe3d on the PATH; activate the environment it is installed in (. .venv/bin/activate)" >&2
  exit 2
fi
if [ ! -d "$set/features" ]; then
  echo "'$set' holds no described fragments; scripts/training_set.sh $set makes them" >&2
  exit 2
fi

data() { geomoe3d data "$@" --workers "$workers"; }
describe() { # FRAGMENTS GRID [OPTION...]: descriptions at a grid in millimetres
  data features "$set/$1" "$set/$1-$2mm" --voxel-size "0.$(printf '%03d' "$2")" "${@:3}"
}
motions() { # DESCRIPTIONS NAME PAIRS
  mkdir -p "$out"
  data transforms "$set/$1" "$out/$2" --pairs "$3"
}

data synthesize "$set/scans" --set recorder=scanner --set grid=0.05 --set min_points=1500 --scenes 60 --seed 0 --models "$models"
data synthesize "$set/bodies" --set recorder=orbit --set min_points=1000 --scenes 160 --seed 0 --models "$models"
some=()
for k in $(seq -f '%05g' 0 39); do some+=(--scene "scene-$k"); done
describe rooms 30 "${some[@]}"
describe rooms 100
describe rooms 200
describe scans 100
describe scans 200
describe bodies 50

motions features rooms-50mm 14000
motions rooms-30mm rooms-30mm 1500
motions rooms-100mm rooms-100mm 2500
motions rooms-200mm rooms-200mm 1000
motions scans-100mm scans-100mm 1500
motions scans-200mm scans-200mm 1000
motions bodies-50mm bodies-50mm 3500
