"""Command line of a ROS process, and the parameter files that it names."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from gp_ground_seg.core.errors import ConfigError, GroundSegError, shown
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import ROS_PARAMETERS_KEY, read_yaml

HIGHEST_DOMAIN = 232
LOG_FOLDER = 'set ROS_LOG_DIR to a folder that the node may write to'
NO_VALUE = ': a value is null or an empty list, which ROS does not read; no input.crop_box is none'


def initialize(words: Sequence[str], context: Any = None) -> None:
    """Initialise rclpy with a command line; raises a ConfigError if that cannot be read.

    Signals are left to the caller. `context` is one of rclpy, by default that of the process.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args

    _check_surroundings(words)
    with start_errors():
        other_words = remove_ros_args(list(words))[1:]
    parser = argparse.ArgumentParser(prog=words[0], usage='%(prog)s [--ros-args ...]')
    parser.parse_args(other_words)
    with start_errors():
        options = SignalHandlerOptions.NO
        rclpy.init(args=list(words), context=context, signal_handler_options=options)


@contextmanager
def start_errors() -> Iterator[None]:
    """Turn what rclpy raises at wrong arguments, names and overrides into a ConfigError."""
    from rclpy.exceptions import NameValidationException, ParameterException

    try:
        yield
    except (ParameterException, NameValidationException, RuntimeError, ValueError) as error:
        if isinstance(error, GroundSegError):
            raise
        # Without the places in the source code of rcl.
        text = re.sub(r', at \S+\.c:\d+', '', ' '.join(str(error).split()))
        kind = type(error).__name__
        is_of_log = text.startswith(('failed to initialize logging', 'Failed opening file'))
        text += f': {LOG_FOLDER}' if is_of_log else ''
        text += NO_VALUE if 'PARAMETER_NOT_SET' in text else ''
        raise ConfigError(text if kind == 'RCLError' else f'{kind}: {text}') from error


def _check_surroundings(words: Sequence[str]) -> None:
    """Raise a ConfigError for what rcl ignores silently, or ends the process for."""
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain.isdecimal() and int(domain) > HIGHEST_DOMAIN:
        raise ConfigError(f'ROS_DOMAIN_ID = {domain}: must be an integer in [0, {HIGHEST_DOMAIN}]')
    if not any(os.environ.get(name) for name in ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')):
        raise ConfigError(f'no folder for logs, as HOME is not set: {LOG_FOLDER}')
    for path in _parameter_files(words):
        try:
            document = read_yaml(path)
        except ConfigError as error:
            raise ConfigError(f'{path}: {error}') from error
        if document and not _node_keys(document):
            raise ConfigError(
                f'{path}: no {ROS_PARAMETERS_KEY}, which the node needs; from bare groups: '
                'gp-ground-seg config dump --config FILE > ros.yaml'
            )


def _parameter_files(words: Sequence[str]) -> list[str]:
    return [path for flag, path in itertools.pairwise(words) if flag == '--params-file']


def with_file(problem: str, words: Sequence[str]) -> str:
    """Return a problem of the parameters, after the last of the files `words` that has it."""
    for path in reversed(_parameter_files(words)):
        if problem in Config.problems_of_file(path):
            return f'{path}: {problem}'
    return problem


def unused_files(words: Sequence[str], node_name: str) -> list[str]:
    """Return a line for each parameter file in which no key is that of the node `node_name`."""
    lines = []
    for path in _parameter_files(words):
        keys: list[str] = []
        with contextlib.suppress(ConfigError):  # it was read before, and may be gone
            keys = _node_keys(read_yaml(path))
        if keys and not any(_is_of_node(key, node_name) for key in keys):
            lines.append(
                f'{shown(path)}: not used: its parameters are those of '
                f'{", ".join(keys)}, and this node is {node_name}; '
                'a key of /** is for every node'
            )
    return lines


def _is_of_node(key: str, node_name: str) -> bool:
    """Whether rclpy gives the parameters of `key` to a node: ``*`` is any word, ``**`` several."""
    rooted = key if key.startswith('/') else f'/{key}'
    # rcl has accepted the key: apart from * it has letters, digits, _ and / only.
    return re.fullmatch(rooted.replace('/*', r'(/\w+)'), node_name) is not None


def _node_keys(document: object, above: str = '') -> list[str]:
    """Return the names, with nested namespaces, whose parameters a document has."""
    if not isinstance(document, dict):
        return []
    found = [above] if ROS_PARAMETERS_KEY in document else []
    for key, below in document.items():
        if key != ROS_PARAMETERS_KEY:
            found += _node_keys(below, f'{above}/{key}' if above else str(key))
    return found
