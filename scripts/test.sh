#!/usr/bin/env bash
# Sets up what the tests need, then checks style and types and runs the tests. Arguments go to pytest.
set -euo pipefail
# shellcheck source=scripts/environment.sh
source "$(dirname -- "${BASH_SOURCE[0]}")/environment.sh"

# The page is tried in a real browser. Ubuntu's package of it is a snap, which not every machine can run.
install_browser() {
  local name
  for name in chromium chromium-browser google-chrome; do
    if command -v "$name" >/dev/null; then return; fi
  done
  if command -v apt-get >/dev/null && grep -qs '^ID=debian' /etc/os-release; then
    install_packages chromium
  else
    say "no Chromium here: the browser test of the page will be skipped"
  fi
}

# Programs that open the files written here.
install_consumers() {
  if command -v pcl_voxel_grid >/dev/null && command -v CloudCompare >/dev/null; then return; fi
  if command -v apt-get >/dev/null; then
    install_packages pcl-tools cloudcompare
  else
    say "no apt-get here: the tests with the Point Cloud Library's programs and CloudCompare will be skipped"
  fi
}

set_up
install_package dev,docs,las,e57,images,train,dask,peers,consumers
install_browser
install_consumers

cd "$checkout"
say "ruff"
"$python" -m ruff check .
"$python" -m ruff format --check .
if "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
  say "mypy"
  "$python" -m mypy
else
  say "mypy is left out: the numpy whose types the code is checked against needs Python 3.11"
fi
# All tests take half an hour of one core, so two to four processes share them; those of one file stay together.
shared=(-n auto --maxprocesses 4 --dist loadfile)
if [ $# -eq 0 ]; then
  say "pytest, the numbers that must not hang on the processor, by a narrow instruction set"
  bash scripts/narrow.sh narrowest "$python" -m pytest -q "${shared[@]}" tests/test_choice.py \
    tests/test_consensus.py tests/test_judge.py tests/test_motion_judge.py tests/test_multiway_grouping.py \
    tests/test_network_folded.py tests/test_registration.py
  set -- "${shared[@]}"
fi
say "pytest"
exec "$python" -m pytest "$@"
