#!/usr/bin/env bash
# Build the tree with colcon as an ament_python package; look for what ros2 run and launch need.
set -euo pipefail
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q 'setuptools>=77,<80' colcon-common-extensions
mkdir -p "$work/ws/src/trackvib"
git ls-files -z --cached --others --exclude-standard | xargs -0 tar c | tar x -C "$work/ws/src/trackvib"

build() {
  (cd "$work/ws" && rm -rf build install log &&
    PATH="$work/venv/bin:$PATH" "$work/venv/bin/colcon" build "$@" --event-handlers console_direct+)
  local prefix=$work/ws/install/trackvib_ros
  for file in share/ament_index/resource_index/packages/trackvib_ros \
    share/trackvib_ros/package.xml \
    share/trackvib_ros/launch/passage.launch.py \
    share/trackvib_ros/config/dds_profile.xml \
    share/trackvib_ros/config/passage.yaml; do
    test -e "$prefix/$file" || { echo "colcon $*: $file is missing"; exit 1; }
  done
  for node in sensor_node detector_node; do
    test -x "$prefix/lib/trackvib_ros/$node" || { echo "colcon $*: $node is no executable"; exit 1; }
  done
  (set +u; source "$work/ws/install/setup.bash" &&
    case ":$AMENT_PREFIX_PATH:" in *":$prefix:"*) ;; *) echo "not in AMENT_PREFIX_PATH"; exit 1 ;; esac
    cd / && "$work/venv/bin/python" -c "
import importlib.util, os
spec = importlib.util.find_spec('trackvib_ros')
assert spec and spec.origin.startswith(os.path.realpath('$work') + '/ws'), spec")
}

build
build --symlink-install
echo "colcon builds the package, plainly and with --symlink-install"
