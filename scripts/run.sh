#!/usr/bin/env bash
# Runs a command in the project's environment and workspace: scripts/run.sh COMMAND [ARG ...]
# If COMMAND is an installed executable of the package, it is run from install/, like `ros2 run`.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
export AMENT_PREFIX_PATH="$root/.venv${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
export PATH="$root/.venv/bin:$PATH"
if [ -f "$root/install/setup.bash" ]; then
  set +u
  # shellcheck disable=SC1091
  source "$root/install/setup.bash"
  set -u
fi
if [ -x "$root/install/monoforce_ros/lib/monoforce_ros/${1:-}" ]; then
  command=$root/install/monoforce_ros/lib/monoforce_ros/$1
  shift
  exec "$command" "$@"
fi
exec "$@"
