"""``config``: the parameters as a file; checks of parameter files."""

from __future__ import annotations

import argparse
import sys

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import shown
from gp_ground_seg.core.parameters.config import Config, find_preset, parameter_specs
from gp_ground_seg.core.parameters.schema import FORM_OF_ROS, is_ours, nodes_of, read_yaml
from gp_ground_seg.ros.arguments import objections_of_ros

EXAMPLES = """\
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


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command and its subcommands."""
    description = 'Show the parameters, their units and ranges.'
    parser = options.command(subparsers, 'config', description, EXAMPLES)
    commands = parser.add_subparsers(metavar='WHAT', required=True)
    options.command(commands, 'dump', DUMP, EXAMPLES, *options.CONFIG, purpose=DUMP, run=run_dump)
    files = 'files', 'parameter file (YAML)', {'metavar': 'FILE', 'nargs': '+'}
    options.command(
        commands, 'check', CHECK_DESCRIPTION, EXAMPLES, files,
        purpose='say everything that is wrong with a parameter file', run=run_check,
    )  # fmt: skip


def run_dump(arguments: argparse.Namespace) -> int:
    """Print the parameters as YAML, with the preset's reasons for the values it has given."""
    config = options.read_config(arguments)
    print(find_preset(arguments.preset).to_yaml(config), end='')
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
            print(shown(f'{path}: {problem}'), file=sys.stderr)
        for node, values in [] if problems else nodes:
            n_changed = len(Config().differences(Config().replace(**values)))
            given = f'{len(values)} of {len(parameter_specs())} parameters given'
            use = '' if node else f' for --config, but not in the form of ROS that {FORM_OF_ROS}'
            if '/' in node.strip('/') or not is_ours(node):
                use = f' for a node named {shown(node)} only'
            print(f'{shown(path)}: good{use}; {given}, {n_changed} unlike the default')
    return code
