#!/usr/bin/env bash
# Runs a command in the project's environment and workspace: scripts/run.sh COMMAND [ARG ...]
# If COMMAND is an installed executable of the package, it is run from install/, like `ros2 run`.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
# shellcheck source=environment.sh
source "$root/scripts/environment.sh"
use_ros_wheels
if [ -f "$root/$install_base/setup.bash" ]; then
  set +u
  # shellcheck disable=SC1090,SC1091
  source "$root/$install_base/setup.bash"
  set -u
fi
executable=$root/$install_base/monoforce_ros/lib/monoforce_ros/${1:-}
if [ -f "$executable" ] && [ -x "$executable" ]; then
  shift
  exec "$executable" "$@"
fi
exec "$@"
