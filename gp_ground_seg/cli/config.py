"""``config``: the parameters as a file, as a table."""

from __future__ import annotations

import argparse
from pathlib import Path

from gp_ground_seg.cli import config_files
from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import DataError
from gp_ground_seg.parameters.export import (
    README_PATH,
    generated_files,
    to_markdown_table,
    to_yaml,
)
from gp_ground_seg.parameters.presets import find_preset

EXAMPLES = """\
examples:
  gp-ground-seg config dump > my.yaml            every parameter, explained, with its default
  gp-ground-seg config dump --config my.yaml --set label.ground_tolerance=0.15
  gp-ground-seg config dump --preset vlp16       those for a sensor, with the reasons
  gp-ground-seg config check my.yaml             unknown names, types, ranges
  gp-ground-seg config diff default my.yaml      what a file, or a preset, changes
  gp-ground-seg config table                     every parameter as a Markdown table
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command and its own commands."""
    parser = subparsers.add_parser(
        'config',
        description='Show the parameters, their units and ranges.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(metavar='WHAT', required=True)

    dump = commands.add_parser(
        'dump',
        help='print the effective parameters as a ROS parameter file',
        description='Print the effective parameters as a ROS parameter file.',
    )
    add_config_options(dump)
    dump.set_defaults(run=run_dump)

    config_files.add_parsers(commands)

    table = commands.add_parser(
        'table',
        help='print every parameter as a Markdown table',
        description='Print every parameter as a Markdown table.',
    )
    table.set_defaults(run=run_table)

    generate = commands.add_parser(
        'generate',
        help='for developers: rewrite what is generated in a checkout',
        description='Rewrite the files of the presets in config/, docs/parameters.md and the '
        'table of README.md from gp_ground_seg/parameters.',
    )
    generate.add_argument(
        'root', metavar='REPO_ROOT', nargs='?', default='.', help='the checkout (default: here)'
    )
    generate.set_defaults(run=run_generate)


def run_dump(arguments: argparse.Namespace) -> int:
    """Print the YAML, with the reasons of a preset for what it says."""
    config = config_from_options(arguments)
    preset = find_preset(arguments.preset)
    is_preset = config == preset.config
    reasons = {
        name: reason
        for name, reason in preset.reasons.items()
        if config[name] == preset.config[name]
    }
    print(to_yaml(config, preset.title if is_preset else '', reasons), end='')
    return 0


def run_table(arguments: argparse.Namespace) -> int:
    """Print the Markdown table."""
    print(to_markdown_table(), end='')
    return 0


def run_generate(arguments: argparse.Namespace) -> int:
    """Rewrite what is generated and has changed, and name it."""
    root = Path(arguments.root)
    readme = root / README_PATH
    if not readme.is_file():
        raise DataError(f'{readme}: no such file; name the root of a checkout')
    try:
        files = generated_files(readme.read_bytes().decode('utf-8'))
    except DataError as error:
        raise DataError(f'{readme}: {error}') from error
    for name, text in files.items():
        _rewrite(root / name, text)
    return 0


def _rewrite(path: Path, text: str) -> None:
    data = text.encode('utf-8')
    changed = not path.exists() or path.read_bytes() != data
    if changed:
        path.parent.mkdir(exist_ok=True)
        with staged_file(path, force=True) as part:
            part.write_bytes(data)
    print(f'{path}: {"rewritten" if changed else "unchanged"}')
