"""``gp-ground-seg node``: the ROS 2 node, where there is no ``ros2 run``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from gp_ground_seg.errors import GroundSegError, MissingDependencyError
from gp_ground_seg.ros.signals import stop_on_signals

OWN_PACKAGE = 'gp_ground_seg'
EXAMPLES = """\
examples:
  gp-ground-seg node
  gp-ground-seg node --ros-args -r points:=/kitti/velo/pointcloud
  gp-ground-seg node --ros-args -p label.ground_tolerance:=0.15 --params-file my.yaml
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command; what follows ``--ros-args`` is left to ROS."""
    parser = subparsers.add_parser(
        'node',
        usage='gp-ground-seg node [--ros-args ...]',
        description='Run the ROS 2 node: points in, ground and obstacles out.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run, accepts_ros_args=True)


def run(arguments: argparse.Namespace) -> int:
    """Run the node with ``arguments.ros_args``."""
    return start(arguments.ros_args)


def start(words: Sequence[str]) -> int:
    """Run the node until it is told to stop; return its exit code.

    Raises
    ------
    MissingDependencyError
        If rclpy or a message package is not installed.
    """
    # Importing ROS takes most of a second; a signal within it is obeyed as well.
    with stop_on_signals() as stop:
        try:
            from gp_ground_seg.ros.node import main as run_node
        except ImportError as error:
            if (error.name or '').startswith(OWN_PACKAGE):
                raise
            raise MissingDependencyError(
                f'the node needs ROS 2, which cannot be imported ({error}): source the setup '
                "file of a ROS 2 installation, or pip install 'gp_ground_seg[ros]'"
            ) from error
        return 0 if stop.made else run_node(words)


def main() -> int:
    """Entry point ``ground_segmentation_node``: says what is missing where there is no ROS."""
    try:
        return start(sys.argv[1:])
    except GroundSegError as error:
        print(f'ground_segmentation_node: error: {error}', file=sys.stderr)
        return 2
