# The node, its code compiled. docs/install.md has more.
#   docker build -t gp_ground_seg .
#   docker run --rm --net host --ipc host gp_ground_seg ros2 launch gp_ground_seg \
#     ground_segmentation.launch.py topic:=/velodyne_points
# By digest: a tag can come to mean another image.
FROM ros:jazzy-ros-base@sha256:c3706ef0a0aa45413c07803cf433602f543b22e45b4855f6fca955c2d8ecc4e8

# A name of LLVM. Not that of the machine that builds, so that any x86 processor since 2013 loads
# the code; on ARM, or older ones: --build-arg CPU_NAME=generic.
ARG CPU_NAME=x86-64-v3
ENV NUMBA_CPU_NAME=$CPU_NAME NUMBA_CPU_FEATURES="" NUMBA_CACHE_DIR=/opt/gp_ground_seg/compiled

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /opt/gp_ground_seg
COPY . src/gp_ground_seg
# hadolint ignore=DL3008,SC1091
RUN apt-get update && rosdep update --rosdistro jazzy \
    && apt-get install -y --no-install-recommends python3-venv \
    && rosdep install --from-paths src --ignore-src -y --dependency-types exec \
    && source /opt/ros/jazzy/setup.bash && src/gp_ground_seg/scripts/setup_workspace.sh \
    && chown -R 1000:1000 "$NUMBA_CACHE_DIR" && rm -rf /var/lib/apt/lists/* build log

RUN printf '#!/bin/bash\nsource /opt/gp_ground_seg/install/setup.bash\nexec "$@"\n' > /entrypoint.sh \
    && chmod 755 /entrypoint.sh
# Ubuntu's first user, as is mostly that of the host: Fast DDS shares memory within one user.
USER 1000:1000
ENTRYPOINT ["/entrypoint.sh"]
CMD ["ros2", "launch", "gp_ground_seg", "ground_segmentation.launch.py"]
