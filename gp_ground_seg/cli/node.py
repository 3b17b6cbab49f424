"""``node``: the ROS 2 node; ``warm-up``: its compiled code; ``config``: its parameter files."""

import argparse
import sys
import time

from gp_ground_seg.cli import options
from gp_ground_seg.core import errors
from gp_ground_seg.core.parameters.config import Config, find_preset, parameter_specs
from gp_ground_seg.core.parameters.schema import FORM_OF_ROS, is_ours, nodes_of, read_yaml
from gp_ground_seg.ros.arguments import objections_of_ros
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
CONFIG_EXAMPLES = """\
  gp-ground-seg config dump > my.yaml        every parameter, explained
  gp-ground-seg config dump --config my.yaml --set label.ground_tolerance=0.15
  gp-ground-seg config dump --preset paper   those of the paper, with reasons
  gp-ground-seg config check my.yaml         unknown names, types, ranges
"""
DUMP = 'print the effective parameters as a ROS parameter file'
CHECK_DESCRIPTION = """\
Check names, types, ranges and the rules between parameters, and say who reads the
file: commands read bare groups too, the node only the form of ROS (/**:
ros__parameters:). Exit code 2 if anything is wrong.
"""


def add_parser(subparsers: options.Subparsers) -> None:
    """Declare the commands; what follows ``--ros-args`` is left to ROS or the node."""
    description = 'Run the ROS 2 node: points in, ground and obstacles out.'
    parser = options.command(
        subparsers, 'node', description, NODE_EXAMPLES,
        run=lambda given: run_node(given.ros_args), accepts_ros_args=True,
    )  # fmt: skip
    parser.usage = 'gp-ground-seg node [--ros-args ...]'
    options.command(subparsers, 'warm-up', WARM_UP_DESCRIPTION, WARM_UP_EXAMPLES, run=run_warm_up)
    description = 'Show the parameters, their units and ranges.'
    parser = options.command(subparsers, 'config', description, CONFIG_EXAMPLES)
    commands = parser.add_subparsers(metavar='WHAT', required=True)
    options.command(
        commands, 'dump', DUMP, CONFIG_EXAMPLES, *options.CONFIG, purpose=DUMP, run=run_dump
    )
    files = 'files', 'parameter file (YAML)', {'metavar': 'FILE', 'nargs': '+'}
    options.command(
        commands, 'check', CHECK_DESCRIPTION, CONFIG_EXAMPLES, files,
        purpose='say everything that is wrong with a parameter file', run=run_check,
    )  # fmt: skip


def main(*, is_managed: bool = False) -> int:
    """Entry point ``ground_segmentation_node``; says what is missing where there is no ROS."""
    try:
        return run_node(sys.argv[1:], is_managed=is_managed)
    except errors.GroundSegError as error:
        print(f'ground_segmentation_node: error: {errors.shown(error)}', file=sys.stderr)
        return 2


def main_managed() -> int:
    """Entry point ``ground_segmentation_lifecycle_node``."""
    return main(is_managed=True)


def run_warm_up(_arguments: argparse.Namespace) -> int:
    """Compile all code that a frame needs."""
    from gp_ground_seg.core.jit import DURATION, HAVE_NUMBA, code_folder
    from gp_ground_seg.ros.loader import compile_all

    if not HAVE_NUMBA:
        raise errors.MissingDependencyError(
            f'numba is not installed, nothing to compile: {errors.install_hint("numba")}'
        )
    errors.LOGGER.info(f'compiling what is not on disk yet: {DURATION} for all of it')
    begin = time.monotonic()
    compile_all()
    seconds, folder = time.monotonic() - begin, code_folder()
    if folder is None:
        raise errors.GroundSegError('compiled code is not kept on disk, see the note above')
    print(f'compiled code is kept in {folder}; it was there after {seconds:.1f} s')
    return 0


def run_dump(arguments: argparse.Namespace) -> int:
    """Print the parameters as YAML, with the preset's reasons for the values it has given."""
    print(find_preset(arguments.preset).to_yaml(options.read_config(arguments)), end='')
    return 0


def run_check(arguments: argparse.Namespace) -> int:
    """Print the problems of each file, or how much it gives and changes."""
    code = 0
    for path in arguments.files:
        problems = Config.problems_of_file(path)
        nodes = [] if problems else nodes_of(read_yaml(path))
        if any(node for node, _ in nodes):
            problems = objections_of_ros(path)
        for problem in problems:
            code = 2
            print(errors.shown(f'{path}: {problem}'), file=sys.stderr)
        for node, values in [] if problems else nodes:
            n_changed = len(Config().differences(Config().replace(**values)))
            given = f'{len(values)} of {len(parameter_specs())} parameters given'
            use = '' if node else f' for --config, but not in the form of ROS that {FORM_OF_ROS}'
            if '/' in node.strip('/') or not is_ours(node):
                use = f' for a node named {errors.shown(node)} only'
            print(f'{errors.shown(path)}: good{use}; {given}, {n_changed} unlike the default')
    return code
