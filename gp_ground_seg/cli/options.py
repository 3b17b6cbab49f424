"""Options that several commands share."""

from __future__ import annotations

import argparse

import yaml

from gp_ground_seg.config import Config
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.parameter_files import load_yaml


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--config FILE`` and ``--set NAME=VALUE``."""
    parser.add_argument('--config', metavar='FILE', help='parameter file (YAML)')
    parser.add_argument(
        '--set',
        metavar='NAME=VALUE',
        action='append',
        default=[],
        dest='settings',
        help='one parameter, as in --set label.ground_tolerance=0.15 (may be repeated)',
    )


def config_from_options(arguments: argparse.Namespace) -> Config:
    """Build the configuration that ``--config`` and ``--set`` ask for.

    Raises
    ------
    ConfigError
        If the file or a setting is not accepted.
    """
    config = Config.from_yaml(arguments.config) if arguments.config else Config()
    changes = {}
    for setting in arguments.settings:
        name, separator, text = setting.partition('=')
        if not separator:
            raise ConfigError(f'--set {setting}: must be NAME=VALUE')
        try:
            changes[name.strip()] = load_yaml(text)
        except yaml.YAMLError as error:
            raise ConfigError(f'--set {setting}: {text!r} is not a value') from error
    return config.replace(**changes)
