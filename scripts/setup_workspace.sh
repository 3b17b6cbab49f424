#!/usr/bin/env bash
# Builds gp_ground_seg in a colcon workspace so that the node runs its compiled code: numba, mcap and rosbags
# go into a virtual environment of the workspace, whose interpreter becomes that of the executables.
#   source /opt/ros/jazzy/setup.bash && src/gp_ground_seg/scripts/setup_workspace.sh [WORKSPACE]
set -euo pipefail

fail() {
    echo "setup_workspace.sh: error: $1" >&2
    exit 2
}

workspace=$(cd "${1:-.}" 2>/dev/null && pwd) || fail "${1:-.}: no such folder"
venv=$workspace/.venv
[ -d "$workspace/src" ] || fail "$workspace has no src: name the workspace, or start this in it"
/usr/bin/python3 -c 'import rclpy.node' 2>/dev/null || fail 'no ROS 2: source /opt/ros/jazzy/setup.bash'
/usr/bin/python3 -c 'import numpy, scipy, yaml, sensor_msgs.msg' 2>/dev/null ||
    fail 'packages are missing: rosdep install --from-paths src --ignore-src -y'
/usr/bin/python3 -c 'import colcon_package_selection, colcon_ros' 2>/dev/null ||
    fail 'no colcon: sudo apt install python3-colcon-common-extensions'
/usr/bin/python3 -c 'import ensurepip' 2>/dev/null || fail 'no virtual environments: sudo apt install python3-venv'

# It sees the packages of ROS and of the distribution; colcon must not search it for packages.
/usr/bin/python3 -m venv --system-site-packages "$venv"
touch "$venv/COLCON_IGNORE"
# scipy of the distribution works with its numpy only: pip chooses a numba for that one. numba looks
# for coverage, and cannot be imported beside the one of Ubuntu 24.04 (7.4), which colcon's tests bring.
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    --constraint <(/usr/bin/python3 -c 'import numpy, scipy; print(f"numpy=={numpy.__version__}\nscipy=={scipy.__version__}")') \
    'numba>=0.60' 'coverage>=7.6' 'mcap>=1.5' 'rosbags>=0.11.9' 'threadpoolctl>=3.1'

# colcon writes the interpreter that it runs in into the executables.
cd "$workspace"
"$venv/bin/python" -m colcon build --packages-up-to gp_ground_seg
bash -c 'source install/setup.bash && install/gp_ground_seg/lib/gp_ground_seg/gp-ground-seg warm-up'
cat <<END
Done. In each terminal:
  source $workspace/install/setup.bash
  ros2 launch gp_ground_seg ground_segmentation.launch.py topic:=/velodyne_points
To build again: $venv/bin/python -m colcon build
END
