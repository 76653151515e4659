#!/usr/bin/env bash
# Tries the wheel in clean environments: one per interpreter, with the tested, lowest or newest versions of what it needs.
#
#     bash scripts/matrix.sh [--lowest | --newest] [--without-torch] PYTHON...
#
# Builds the wheel; makes an environment for each PYTHON (such as python3.12), installs the wheel there, runs the
# README's commands in an empty folder, then the tests of files, registration and results. --without-torch
# leaves PyTorch out, as the classical path allows. Ends with a line per interpreter; exit code 1 if one failed.
set -euo pipefail
checkout=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd)
versions=tested
torch=yes
while [ $# -gt 0 ]; do
  case $1 in
    --lowest | --newest) versions=${1#--} ;;
    --without-torch) torch=no ;;
    *) break ;;
  esac
  shift
done
[ $# -gt 0 ] || { echo "usage: matrix.sh [--lowest | --newest] [--without-torch] PYTHON..." >&2; exit 2; }

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${BUILD_PYTHON:-$1}" -m venv "$work/build"
"$work/build/bin/pip" -q install build
"$work/build/bin/python" -m build --wheel --outdir "$work/dist" "$checkout" >"$work/build.log" 2>&1 ||
  { cat "$work/build.log" >&2; exit 1; }
wheel=$(echo "$work"/dist/*.whl)

# What the wheel asks for, one requirement a line, as `pip install -r` and `-c` take it.
requirements() {
  "$1" - "$wheel" "$versions" "$torch" <<'PYTHON'
import re, sys, zipfile
wheel, versions, torch = sys.argv[1:]
with zipfile.ZipFile(wheel) as files:
    name = next(name for name in files.namelist() if name.endswith(".dist-info/METADATA"))
    lines = files.read(name).decode().splitlines()
for line in lines:
    if line.startswith("Requires-Dist: ") and "extra ==" not in line:
        need = line.removeprefix("Requires-Dist: ")
        if torch == "yes" or not need.startswith("torch"):
            print(re.sub(r">=", "==", need) if versions == "lowest" else need)
PYTHON
}

tests=(test_formats_ply test_formats_pcd test_formats_text test_formats_arrays test_formats_scans test_formats_las
  test_formats_e57 test_loading test_saving test_transform_files test_registration test_result test_cli_register
  test_visual_sheet)
files=("${tests[@]/#/$checkout/tests/}")
files=("${files[@]/%/.py}")
report=()
failed=0
for interpreter in "$@"; do
  name=$("$interpreter" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  venv="$work/$name"
  echo "== Python $name, $versions versions, PyTorch: $torch"
  "$interpreter" -m venv "$venv"
  constraint=()
  [ "$versions" != tested ] || constraint=(--constraint "$checkout/constraints.txt")
  requirements "$venv/bin/python" >"$work/needs.txt"
  said=ok
  {
    "$venv/bin/pip" -q install "${constraint[@]}" -r "$work/needs.txt" pytest pytest-timeout hypothesis \
      "laspy[lazrs]" pye57 &&
      "$venv/bin/pip" -q install --no-deps "$wheel" &&
      mkdir "$work/empty-$name" && cd "$work/empty-$name" &&
      "$venv/bin/geomoe3d" sample sample &&
      "$venv/bin/geomoe3d" register sample/source.ply sample/target.ply --output T.txt --aligned aligned.ply &&
      "$venv/bin/geomoe3d" register sample/source.ply sample/target.ply --picture picture.png --page page.html --quiet &&
      "$venv/bin/pytest" -q -p no:cacheprovider "${files[@]}" 2>/dev/null
  } || said=FAILED
  [ "$said" = ok ] || failed=1
  report+=("Python $name, $versions versions, PyTorch $torch: $said ($("$venv/bin/pip" list 2>/dev/null |
    awk '/^(numpy|scipy|open3d-cpu|matplotlib|pydantic|trimesh) / {printf "%s %s ", $1, $2}'))")
  rm -rf "$venv"
done
printf '%s\n' "${report[@]}"
exit $failed
