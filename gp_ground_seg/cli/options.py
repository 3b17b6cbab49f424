"""Options that several commands share."""

from __future__ import annotations

import argparse
from typing import Any

import yaml

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.presets import PRESETS, find_preset
from gp_ground_seg.parameters.yaml_io import load_yaml

DEFAULT_PRESET = 'default'


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--preset NAME``, ``--config FILE`` and ``--set NAME=VALUE``."""
    parser.add_argument(
        '--preset',
        metavar='NAME',
        default=DEFAULT_PRESET,
        help=f'parameters of a sensor: {", ".join(PRESETS)} (default: {DEFAULT_PRESET})',
    )
    parser.add_argument('--config', metavar='FILE', help='parameter file (YAML), over the preset')
    parser.add_argument(
        '--set',
        metavar='NAME=VALUE',
        action='append',
        default=[],
        dest='settings',
        help='one parameter, as in --set label.ground_tolerance=0.15 (may be repeated)',
    )


def config_from_options(arguments: argparse.Namespace) -> Config:
    """Build the configuration that ``--preset``, ``--config`` and ``--set`` ask for.

    The file changes what the preset gives, the settings what the file gives.

    Raises
    ------
    ConfigError
        If the preset, the file or a setting is not accepted.
    """
    config = find_preset(arguments.preset).config
    if arguments.config:
        config = Config.from_yaml(arguments.config, config)
    return config.replace(**dict(parse_setting(setting) for setting in arguments.settings))


def parse_setting(setting: str) -> tuple[str, Any]:
    """Read ``NAME=VALUE``; whether the parameter takes the value is not looked at.

    Raises
    ------
    ConfigError
        If it is not of that form.
    """
    name, separator, text = setting.partition('=')
    if not separator:
        raise ConfigError(f'--set {setting}: must be NAME=VALUE')
    try:
        return name.strip(), load_yaml(text)
    except yaml.YAMLError as error:
        raise ConfigError(f'--set {setting}: {text!r} is not a value') from error
