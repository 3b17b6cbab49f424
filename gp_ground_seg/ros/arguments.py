"""ROS arguments that rcl would refuse in words of its own, or in several lines."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import yaml
from rclpy.exceptions import NameValidationException
from rclpy.validate_namespace import validate_namespace
from rclpy.validate_node_name import validate_node_name

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.parameters.yaml_io import ROS_NODE_KEY, ROS_PARAMETERS_KEY, load_yaml

START, END = '--ros-args', '--'
HIGHEST_DOMAIN = 232
"""Above it, the ports of DDS would be none."""
_PARAMETER = ('-p', '--param')
_REMAP = ('-r', '--remap')
_NAME_RULE = re.compile(r'(?:[^:]*:)?__(node|name|ns):=(.*)', re.DOTALL)


def check_ros_arguments(words: Sequence[str]) -> None:
    """Check what a user may easily get wrong; rcl checks the rest.

    Parameters
    ----------
    words : sequence of str
        Words of the command line.

    Raises
    ------
    ConfigError
        If a rule or a parameter file cannot be understood, or ``ROS_DOMAIN_ID`` is too high.
    """
    _check_domain(os.environ.get('ROS_DOMAIN_ID', ''))
    for flag, value in _pairs(words):
        if flag in _PARAMETER:
            _check_parameter(f'{flag} {value}', value)
        elif flag in _REMAP:
            _check_remap(f'{flag} {value}', value)
        elif flag == '--params-file':
            _check_file(value)


def _pairs(words: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield flags and what follows them, between ``--ros-args`` and ``--``."""
    in_ros_args = False
    k = 0
    while k < len(words):
        word = words[k]
        if not in_ros_args or word == END:
            in_ros_args = word == START
        elif word in (*_PARAMETER, *_REMAP, '--params-file') and k + 1 < len(words):
            k += 1
            yield word, words[k]
        k += 1


def _check_domain(domain: str) -> None:
    if domain.isdecimal() and int(domain) > HIGHEST_DOMAIN:
        raise ConfigError(f'ROS_DOMAIN_ID = {domain}: must be an integer in [0, {HIGHEST_DOMAIN}]')


def _check_parameter(rule: str, text: str) -> None:
    name, separator, value = text.partition(':=')
    if not separator or not name or not value:
        raise ConfigError(f'{rule}: must be -p NAME:=VALUE')
    if name == 'use_sim_time':
        try:
            _check_sim_time(load_yaml(value))
        except yaml.YAMLError:
            _check_sim_time(value)


def _check_remap(rule: str, text: str) -> None:
    source, separator, target = text.partition(':=')
    if not separator or not source or not target:
        raise ConfigError(f'{rule}: must be -r FROM:=TO, as in -r points:=/kitti/velo/pointcloud')
    named = _NAME_RULE.fullmatch(text)
    if named is None:
        return
    try:
        if named[1] == 'ns':
            validate_namespace(named[2])
        else:
            validate_node_name(named[2])
    except NameValidationException as error:
        raise ConfigError(f'{rule}: {" ".join(str(error).split())}') from error


def _check_file(path: str) -> None:
    try:
        if not Path(path).is_file():
            reason = 'is a folder' if Path(path).is_dir() else 'no such file'
            raise ConfigError(f'{path}: {reason}')
        document = load_yaml(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise ConfigError(f'{path}: {error.strerror or error}') from error
    except UnicodeDecodeError as error:
        raise ConfigError(f'{path}: not a text file') from error
    except (yaml.YAMLError, RecursionError) as error:
        raise ConfigError(f'{path}: not valid YAML: {" ".join(str(error).split())}') from error
    except ConfigError as error:
        raise error if str(error).startswith(path) else ConfigError(f'{path}: {error}') from error
    if document is None:
        return
    if not isinstance(document, Mapping) or not _has_parameters(document):
        raise ConfigError(
            f"{path}: no {ROS_PARAMETERS_KEY}; in a parameter file of ROS, '{ROS_NODE_KEY}:' is "
            f"the first line, '  {ROS_PARAMETERS_KEY}:' the second, and what follows is indented "
            'further'
        )
    for_all = document.get(ROS_NODE_KEY)
    parameters = for_all.get(ROS_PARAMETERS_KEY) if isinstance(for_all, Mapping) else None
    if isinstance(parameters, Mapping) and 'use_sim_time' in parameters:
        _check_sim_time(parameters['use_sim_time'])


def _has_parameters(document: Mapping[str, object]) -> bool:
    """Whether the parameters of some node, possibly below namespaces, are there."""
    return any(
        isinstance(value, Mapping) and (ROS_PARAMETERS_KEY in value or _has_parameters(value))
        for value in document.values()
    )


def _check_sim_time(value: object) -> None:
    if not isinstance(value, bool):
        raise ConfigError(f'use_sim_time = {value!r}: must be true or false')
