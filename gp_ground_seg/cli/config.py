"""``config``: the parameters as a file, as a table."""

from __future__ import annotations

import argparse
from pathlib import Path

from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.config import Config
from gp_ground_seg.config_export import replace_readme_table, to_markdown_table, to_yaml
from gp_ground_seg.datasets.staging import staged_file
from gp_ground_seg.errors import DataError

YAML_PATH = 'config/ground_segmentation.yaml'
"""Generated file, below the root of a checkout."""

README_PATH = 'README.md'
"""File with a generated section, below the root of a checkout."""

EXAMPLES = """\
examples:
  gp-ground-seg config dump > my.yaml            every parameter, explained, with its default
  gp-ground-seg config dump --config my.yaml --set label.ground_tolerance=0.15
  gp-ground-seg config table                     every parameter as a Markdown table
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command and its own commands."""
    parser = subparsers.add_parser(
        'config',
        help='write parameter files',
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

    table = commands.add_parser(
        'table',
        help='print every parameter as a Markdown table',
        description='Print every parameter as a Markdown table.',
    )
    table.set_defaults(run=run_table)

    generate = commands.add_parser(
        'generate',
        help='for developers: rewrite what is generated in a checkout',
        description='Rewrite config/ground_segmentation.yaml and the parameter table of README.md '
        'from the declaration in gp_ground_seg/config.py.',
    )
    generate.add_argument(
        'root', metavar='REPO_ROOT', nargs='?', default='.', help='the checkout (default: here)'
    )
    generate.set_defaults(run=run_generate)


def run_dump(arguments: argparse.Namespace) -> int:
    """Print the YAML."""
    print(to_yaml(config_from_options(arguments)), end='')
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
    _rewrite(root / YAML_PATH, to_yaml(Config()))
    try:
        _rewrite(readme, replace_readme_table(readme.read_bytes().decode('utf-8')))
    except DataError as error:
        raise DataError(f'{readme}: {error}') from error
    return 0


def _rewrite(path: Path, text: str) -> None:
    data = text.encode('utf-8')
    changed = not path.exists() or path.read_bytes() != data
    if changed:
        path.parent.mkdir(exist_ok=True)
        with staged_file(path, force=True) as part:
            part.write_bytes(data)
    print(f'{path}: {"rewritten" if changed else "unchanged"}')
