"""``node``: the ROS 2 node; ``warm-up``: compile its code beforehand."""

from __future__ import annotations

import argparse
import sys
import time

from gp_ground_seg.cli import options
from gp_ground_seg.core import errors
from gp_ground_seg.core.errors import GroundSegError
from gp_ground_seg.ros.node_process import run_node

NODE_EXAMPLES = """\
  gp-ground-seg node
  gp-ground-seg node --ros-args -r points:=/kitti/velo/pointcloud
  gp-ground-seg node --ros-args --params-file my.yaml -p sensor.height:=1.2
"""
WARM_UP_DESCRIPTION = """\
Compile what the node would compile at its first start, for a robot or an image of one. The
node then has its compiled code after a second, not after 20 to 60. The code is kept on disk,
for this version, this processor and this user.
"""
WARM_UP_EXAMPLES = """\
  gp-ground-seg warm-up
  NUMBA_CACHE_DIR=/opt/robot/numba gp-ground-seg warm-up
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the commands; what follows ``--ros-args`` is left to ROS or the node."""
    description = 'Run the ROS 2 node: points in, ground and obstacles out.'
    parser = options.command(
        subparsers, 'node', description, NODE_EXAMPLES,
        run=lambda given: run_node(given.ros_args), accepts_ros_args=True,
    )  # fmt: skip
    parser.usage = 'gp-ground-seg node [--ros-args ...]'
    options.command(subparsers, 'warm-up', WARM_UP_DESCRIPTION, WARM_UP_EXAMPLES, run=run_warm_up)


def main(*, is_managed: bool = False) -> int:
    """Entry point ``ground_segmentation_node``; says what is missing where there is no ROS."""
    try:
        return run_node(sys.argv[1:], is_managed=is_managed)
    except GroundSegError as error:
        print(f'ground_segmentation_node: error: {errors.shown(error)}', file=sys.stderr)
        return 2


def main_managed() -> int:
    """Entry point ``ground_segmentation_lifecycle_node``."""
    return main(is_managed=True)


def run_warm_up(_arguments: argparse.Namespace) -> int:
    """Compile all code that a frame needs."""
    from gp_ground_seg.core.jit import HAVE_NUMBA, code_folder
    from gp_ground_seg.ros.loader import compile_all

    if not HAVE_NUMBA:
        raise errors.MissingDependencyError(
            f'numba is not installed, nothing to compile: {errors.install_hint("numba")}'
        )
    errors.LOGGER.info('compiling what is not on disk yet: 20 to 60 s for all of it')
    begin = time.monotonic()
    compile_all()
    seconds, folder = time.monotonic() - begin, code_folder()
    if folder is None:
        raise GroundSegError('compiled code is not kept on disk, see the note above')
    print(f'compiled code is kept in {folder}; it was there after {seconds:.1f} s')
    return 0
