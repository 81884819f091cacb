#!/usr/bin/env bash
# Creates .venv with the locked packages and builds the package with colcon.
# Finished steps are marked by stamp files, so repeated calls are fast.
#   scripts/set_up.sh environment | build | interfaces | graphics
#   MONOFORCE_ENVIRONMENT=lowest scripts/set_up.sh build     the same with the lowest supported versions, beside the others
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
# shellcheck source=environment.sh
source scripts/environment.sh

say() { printf '[set-up] %s\n' "$*"; }

# A command named python3.12 may be a non-working shim, so check the version that each candidate reports.
is_python_312() {
  [ "$("$1" -c 'import sys, venv, ensurepip; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)" = 3.12 ]
}

find_python() {
  local candidate
  for candidate in "${MONOFORCE_PYTHON:-}" python3.12 /usr/bin/python3.12 /usr/local/bin/python3.12 \
    "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12*/bin/python3.12 \
    "${UV_PYTHON_INSTALL_DIR:-$HOME/.local/share/uv/python}"/cpython-3.12*/bin/python3.12 \
    /opt/python*/bin/python3.12 /opt/homebrew/bin/python3.12 python3 python; do
    [ -n "$candidate" ] || continue
    if is_python_312 "$candidate"; then
      command -v "$candidate"
      return 0
    fi
  done
  return 1
}

environment() {
  local started=$SECONDS lock_hash python
  lock_hash=$(sha256sum "$lock" | cut -d' ' -f1)
  if [ -f "$venv/.locked" ] && [ "$(cat "$venv/.locked")" = "$lock_hash" ]; then
    say "the environment is up to date"
    return
  fi
  # Recreate the environment when the lock file changes: removing one of several packages that share a folder, such as the ROS
  # packages, breaks the others.
  if [ -f "$venv/.locked" ] || ! is_python_312 "$venv/bin/python"; then
    if ! python=$(find_python); then
      cat >&2 <<'TEXT'
[set-up] No working Python 3.12 with the venv module was found.
         Tried: $MONOFORCE_PYTHON, python3.12 on PATH, pyenv's and uv's versions, /usr, /opt.
         Install one of:
           Ubuntu 24.04:  sudo apt install python3.12 python3.12-venv
           pyenv:         pyenv install 3.12
           uv:            uv python install 3.12
         or select one:   MONOFORCE_PYTHON=/path/to/python3.12 make test
TEXT
      exit 1
    fi
    say "creating ${venv##*/} with $python"
    rm -rf "$venv"
    "$python" -m venv "$venv"
  fi
  local uv_version
  uv_version=$(sed -n 's/^uv==\([^ ;]*\).*/\1/p' "$lock")
  say "installing uv $uv_version"
  "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "uv==$uv_version"
  say "installing $(grep -c '^[a-z0-9].*==' "$lock") locked packages (several GB, most of it torch's CUDA libraries)"
  # Compile bytecode once, or every start of a node compiles all of torch if Python may not write bytecode.
  "$venv/bin/uv" pip sync --quiet --compile-bytecode --python "$venv/bin/python" "$lock"
  printf '%s' "$lock_hash" >"$venv/.locked"
  say "environment ready after $((SECONDS - started)) s"
}

build() {
  local stamp=$install_base/.built started=$SECONDS
  if [ -f "$stamp" ] && [ -z "$(find package.xml setup.py setup.cfg resource config launch msg_defs bags models monoforce_ros \
    -newer "$stamp" -not -name '*.pyc' -not -name __pycache__ -print -quit)" ]; then
    say "the build is up to date"
    return
  fi
  use_ros_wheels
  say "building with colcon"
  # Files removed from the source must not stay installed.
  rm -rf "$build_base/monoforce_ros" "$install_base/monoforce_ros"
  mkdir -p out
  if ! colcon --log-base log build --build-base "$build_base" --install-base "$install_base" \
    --event-handlers console_cohesion- >out/colcon_build.log 2>&1; then
    cat out/colcon_build.log >&2
    exit 1
  fi
  "$venv/bin/python" -m compileall -q "$install_base/monoforce_ros/lib"
  touch "$stamp"
  say "built into $install_base/ after $((SECONDS - started)) s"
}

# Builds the typed messages for planners, and those messages of ROS packages that are not on PyPI, next to monoforce_ros
# in install/. Only this step needs a C++ compiler.
interfaces() {
  local stamp=$install_base/.interfaces started=$SECONDS headers arrays package packages=()
  if [ -f "$stamp" ] && [ -z "$(find msg_defs -type f -newer "$stamp" -print -quit)" ]; then
    say "the message packages are up to date"
    return
  fi
  if ! command -v c++ >/dev/null; then
    say "no C++ compiler: messages are not built, their tests will be skipped (sudo apt install g++)"
    return
  fi
  use_ros_wheels
  headers=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_paths()["include"])')
  # Without links: several checkouts may share an environment.
  arrays=$("$venv/bin/python" -c 'import numpy, os; print(os.path.realpath(numpy.get_include()))')
  if [ ! -f "$headers/Python.h" ]; then
    say "no headers of Python in $headers: messages are not built, their tests will be skipped (sudo apt install python3-dev)"
    return
  fi
  set_include_folders "$venv" "$headers" "$arrays"
  # An installed ROS has the complete packages; what an earlier call built into install/ does not count.
  for package in msg_defs/*/package.xml; do
    package=$(dirname "$package")
    "$venv/bin/python" -c "import sys, $(basename "$package").msg as m; sys.exit(m.__file__.startswith('$root/$install_base/'))" \
      2>/dev/null || packages+=("$package")
  done
  if [ ${#packages[@]} = 0 ]; then
    say "every message package is installed"
    touch "$stamp"
    return
  fi
  say "building ${packages[*]#msg_defs/}"
  mkdir -p out
  if ! colcon --log-base log build --base-paths "${packages[@]}" --build-base "$build_base" --install-base "$install_base" \
    --event-handlers console_cohesion- --cmake-args -G Ninja -DBUILD_TESTING=OFF -DCMAKE_BUILD_TYPE=Release \
    -DPython3_EXECUTABLE="$venv/bin/python" >out/interfaces.log 2>&1; then
    cat out/interfaces.log >&2
    exit 1
  fi
  touch "$stamp"
  say "messages built after $((SECONDS - started)) s"
}

# Only rendering camera images of synthetic worlds needs a GL library.
graphics() {
  if ldconfig -p 2>/dev/null | grep -q 'libOSMesa\.so'; then
    say "OSMesa is installed: synthetic camera images can be rendered"
  elif [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say "installing OSMesa, which renders synthetic camera images without a display"
    { apt-get -qq update && apt-get -qq install -y --no-install-recommends libosmesa6; } >/dev/null 2>&1 \
      || say "OSMesa could not be installed: tests that render images will be skipped"
  else
    say "OSMesa is missing: tests that render synthetic images will be skipped (sudo apt install libosmesa6)"
  fi
}

case "${1:-}" in
  environment | build | interfaces | graphics) "$1" ;;
  *)
    echo "usage: scripts/set_up.sh environment|build|interfaces|graphics" >&2
    exit 2
    ;;
esac
