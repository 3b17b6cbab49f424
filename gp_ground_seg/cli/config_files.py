"""``config check``, ``config diff`` and ``config presets``."""

from __future__ import annotations

import argparse
import sys

from gp_ground_seg.parameters.config import Config, parameter_specs
from gp_ground_seg.parameters.export import differences, file_problems, yaml_scalar
from gp_ground_seg.parameters.presets import PRESETS
from gp_ground_seg.parameters.yaml_io import read_parameters

EXIT_DIFFERENT = 1
EXIT_WRONG = 2


def add_parsers(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the three commands."""
    check = commands.add_parser(
        'check',
        help='say everything that is wrong with a parameter file',
        description='Check names, types, ranges and the rules between parameters. A file in the '
        'form of ROS (/**: ros__parameters:) is held to the types of ROS: 2.0, not 2, for a '
        'float. Exit code 2 if anything is wrong.',
    )
    check.add_argument('files', metavar='FILE', nargs='+', help='parameter file (YAML)')
    check.set_defaults(run=run_check)

    diff = commands.add_parser(
        'diff',
        help='compare two parameter files or presets',
        description='Print the parameters that differ. A and B are parameter files or names of '
        'presets. Exit code 1 if any differ, as that of diff(1).',
    )
    diff.add_argument('a', metavar='A', help='parameter file or preset')
    diff.add_argument('b', metavar='B', help='parameter file or preset')
    diff.set_defaults(run=run_diff)

    presets = commands.add_parser(
        'presets', help='list the presets', description='List the presets and what they are for.'
    )
    presets.set_defaults(run=run_presets)


def run_check(arguments: argparse.Namespace) -> int:
    """Print what is wrong with each file, or what is in it."""
    code = 0
    for path in arguments.files:
        problems = file_problems(path)
        for problem in problems:
            print(f'{path}: {problem}', file=sys.stderr)
        if problems:
            code = EXIT_WRONG
        else:
            n_given = len(read_parameters(path).values)
            n_changed = len(differences(Config(), Config.from_yaml(path)))
            print(
                f'{path}: good; {n_given} of {len(parameter_specs())} parameters given, '
                f'{n_changed} differ from the defaults'
            )
    return code


def run_diff(arguments: argparse.Namespace) -> int:
    """Print the parameters that differ."""
    different = differences(_load(arguments.a), _load(arguments.b))
    for spec, first, second in different:
        unit = f' {spec.unit}' if spec.unit else ''
        print(f'{spec.name}: {yaml_scalar(first)} -> {yaml_scalar(second)}{unit}')
    return EXIT_DIFFERENT if different else 0


def _load(name: str) -> Config:
    """Preset of this name, or else the file."""
    return PRESETS[name].config if name in PRESETS else Config.from_yaml(name)


def run_presets(_arguments: argparse.Namespace) -> int:
    """Print name and purpose of each preset."""
    width = max(map(len, PRESETS))
    for preset in PRESETS.values():
        print(f'{preset.name:<{width}}  {preset.purpose}')
    return 0
