# Functions that quickstart.sh and test.sh share: what the machine needs, and the environment in .venv.
# Sourced, not run. Every step looks first and does only what is missing, and says what it installs.
# shellcheck shell=bash

checkout=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd)
venv="$checkout/.venv"
python="$venv/bin/python"
torch_version=$(sed -n 's/^torch==//p' "$checkout/constraints.txt")

say() { printf '\n== %s\n' "$*"; }
fail() {
  printf '\nerror: %s\n' "$*" >&2
  exit 1
}

# Debian packages by name; nothing to do without arguments.
install_packages() {
  [ $# -gt 0 ] || return 0
  say "system packages: $*"
  local root=()
  if ! command -v apt-get >/dev/null; then
    fail "this system has no apt-get; install with its own package manager what Debian calls: $*"
  fi
  if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null || fail "not root and no sudo; have an administrator run: apt-get install $*"
    root=(sudo)
  fi
  ${root[@]+"${root[@]}"} apt-get update -qq
  ${root[@]+"${root[@]}"} env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"
}

is_suitable() { "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2])' 2>/dev/null; }

# The interpreter to build .venv with, into $base: the variable PYTHON, else the first one that will do.
choose_python() {
  local candidate
  if [ -n "${PYTHON:-}" ]; then
    base=$(command -v -- "$PYTHON") || fail "PYTHON=$PYTHON: no such program"
    is_suitable "$base" || fail "PYTHON=$PYTHON is not Python 3.10 or newer"
    return
  fi
  for candidate in python3 python3.13 python3.12 python3.11 python3.10; do
    if base=$(command -v "$candidate") && is_suitable "$base"; then return; fi
  done
  install_packages python3 python3-venv
  base=$(command -v python3)
  is_suitable "$base" || fail "python3 is older than 3.10; name a newer one with the variable PYTHON"
}

make_venv() {
  if [ -x "$python" ] && "$python" -m pip --version >/dev/null 2>&1; then
    if [ -n "${PYTHON:-}" ] && [ "$("$PYTHON" --version)" != "$("$python" --version)" ]; then
      say "note: $venv stays as it is, with $("$python" --version); remove it to change to $PYTHON"
    fi
    return
  fi
  choose_python
  if ! "$base" -c 'import ensurepip, venv' 2>/dev/null; then
    install_packages "$("$base" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"
  fi
  say "virtual environment: $venv ($("$base" --version))"
  "$base" -m venv --clear "$venv"
}

# The shared libraries that Open3D loads; geomoe3d.doctor knows which, and needs only Python itself.
install_system_libraries() {
  local missing
  missing=$(cd "$checkout" && "$python" -m geomoe3d.doctor --apt)
  # shellcheck disable=SC2086  # one word per package
  install_packages $missing
}

# pip with the tested versions, silent but for the packages that it installed.
pip_install() {
  "$python" -m pip install --disable-pip-version-check --progress-bar off \
    --constraint "$checkout/constraints.txt" "$@" |
    sed -n 's/^Successfully installed/installed:/p'
}

# torch first and by itself: as a dependency pip would take the newest one, on Linux with CUDA, several GB.
install_torch() {
  if "$python" -c 'import importlib.metadata as m; m.version("torch")' 2>/dev/null; then return; fi
  if nvidia-smi -L >/dev/null 2>&1; then
    say "torch $torch_version, for the GPU"
    pip_install "torch==$torch_version"
  elif [ -n "${GEOMOE3D_TORCH_INDEX:-}" ]; then
    say "torch $torch_version, from GEOMOE3D_TORCH_INDEX"
    pip_install --index-url "$GEOMOE3D_TORCH_INDEX" "torch==$torch_version"
  else
    say "torch $torch_version, the CPU build where pip can find it"
    pip_install "torch==$torch_version+cpu" 2>/dev/null || pip_install "torch==$torch_version"
  fi
}

# install_package EXTRA,...: this checkout, editable. Done again only after a change of what it depends on.
install_package() {
  local extras="${1:+[$1]}" stamp state
  stamp="$venv/.geomoe3d${1:+-$1}"
  state=$(cat "$checkout/pyproject.toml" "$checkout/constraints.txt" | cksum)" $checkout"
  if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$state" ]; then return; fi
  say "geomoe3d$extras and the Python packages it depends on"
  (cd "$checkout" && pip_install --editable ".$extras")
  printf '%s' "$state" >"$stamp"
}

set_up() {
  make_venv
  install_system_libraries
  install_torch
  install_package ""
}
