# Sourced by run.sh and set_up.sh with `root` set to the repository: which environment they use, and how ROS finds it.
#   MONOFORCE_ENVIRONMENT=lowest selects .venv-lowest, requirements-lowest.lock, build-lowest and install-lowest.
# shellcheck shell=bash
# shellcheck disable=SC2154
environment_suffix=${MONOFORCE_ENVIRONMENT:+-$MONOFORCE_ENVIRONMENT}
venv=$root/.venv$environment_suffix
lock=$root/requirements$environment_suffix.lock
build_base=build$environment_suffix
install_base=install$environment_suffix
# The tests start what is installed there.
export MONOFORCE_INSTALL=$root/$install_base

# Entries of the colon-separated list $1 that lie in none of the folders that follow.
entries_outside() {
  local list=$1 entry folder kept=
  shift
  while IFS= read -r -d : entry; do
    [ -n "$entry" ] || continue
    for folder in "$@"; do
      case "$entry/" in "$folder"/*) continue 2 ;; esac
    done
    kept=${kept:+$kept:}$entry
  done <<<"$list:"
  printf '%s' "$kept"
}

# A sourced ROS installation and the ROS wheels of the virtual environment have libraries and Python packages of the same
# names, built apart: a process that loads some of each crashes or waits for ever. The environment's own wheels win.
leave_out_sourced_ros() {
  local others=() prefix variable value
  while IFS= read -r -d : prefix; do
    case "$prefix/" in / | "$root"/*) ;; *) others+=("${prefix%/}") ;; esac
  done <<<"${AMENT_PREFIX_PATH:-}:"
  # setup.bash of /opt/ros appends to more than AMENT_PREFIX_PATH, which another script may have reset since.
  others+=(/opt/ros)
  for variable in AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PATH PKG_CONFIG_PATH PYTHONPATH; do
    value=${!variable:-}
    [ -n "$value" ] || continue
    value=$(entries_outside "$value" "${others[@]}")
    if [ -n "$value" ]; then export "$variable=$value"; else unset "$variable"; fi
  done
  if [ "${#others[@]}" -gt 1 ]; then
    echo "[environment] leaving out the sourced ROS of ${others[0]}: this command uses the ROS wheels of ${venv##*/}." \
      "To use the installed ROS instead, see README.md, \"On a robot with ROS 2 Jazzy\"." >&2
  fi
}

# rosidl and ament search AMENT_PREFIX_PATH, which the wheels do not set. The guard variable marks the library path as
# set up and must be removed together with it.
use_ros_wheels() {
  leave_out_sourced_ros
  unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
  export AMENT_PREFIX_PATH="$venv${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
  export PATH="$venv/bin:$PATH"
}

# The exported CMake targets of the wheels in the environment $1 name the folders of the headers of Python and NumPy where the
# wheels were built, or where an earlier call found them. Sets them to $2 and $3.
set_include_folders() {
  { grep -rlZE '"/[^"]*/(include/python3|numpy/[^;"]*include)' "$1"/share/*/cmake || true; } | xargs -0r sed -i \
    -e "s#/[^;\"]*/include/python3[.0-9]*#$2#g" -e "s#/[^;\"]*/numpy/[^;\"]*include#$3#g"
}
