"""Command line of a ROS process, and the parameter files that it names."""

import argparse
import contextlib
import itertools
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gp_ground_seg.core.errors import ConfigError, GroundSegError, shown
from gp_ground_seg.core.parameters import schema
from gp_ground_seg.core.parameters.config import Config

_HIGHEST = {
    'ROS_DOMAIN_ID': 232,
    'RCUTILS_COLORIZED_OUTPUT': 1,
    'RCUTILS_LOGGING_BUFFERED_STREAM': 1,
    'RCUTILS_LOGGING_USE_STDOUT': 1,
}
"""Whole numbers in the environment, with the highest of each."""
LOG_FOLDER = 'set ROS_LOG_DIR to a folder that the node may write to'
_NAMES = (
    'must be OLD:=NEW, of topics such as /front/points: words of letters, digits and single _, '
    'none begins with a digit, / between them and not at the end; NEW of __ns begins with /, that '
    'of __node is one word'
)
_RULES = {
    'remap rule': _NAMES,
    'node namespace': _NAMES,
    'parameter override rule': 'must be NAME:=VALUE, as in sensor.height:=1.2',
    'use_sim_time': 'must be true or false',
    'severity level': 'must be debug, info, warn, error or fatal, or NAME:= one of them',
    'Enclave name': 'as in /front/lidar',
    'failed to initialize logging': LOG_FOLDER,
    'Failed opening file': LOG_FOLDER,
}
"""Rules of ROS in words, by a part of its lines, which name places in its code instead."""


def initialize(words: Sequence[str], context: Any = None) -> None:
    """Initialise rclpy with a command line; raises a ConfigError if that cannot be read.

    Signals are left to the caller. `context` is one of rclpy, by default that of the process.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args

    _check_surroundings(words)
    parser = argparse.ArgumentParser(prog=words[0], usage='%(prog)s [--ros-args ...]')
    with start_errors():
        parser.parse_args(remove_ros_args(list(words))[1:])
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
        text = re.sub(r', at \S+\.[chp]+:\d+', '', ' '.join(str(error).split()))
        kind = type(error).__name__
        rules = [rule for part, rule in _RULES.items() if part in text]
        text = ': '.join([text, *rules[:1]])
        raise ConfigError(text if kind == 'RCLError' else f'{kind}: {text}') from error


def _check_surroundings(words: Sequence[str]) -> None:
    """Raise a ConfigError for what rcl ignores silently, or ends the process for."""
    for name, most in _HIGHEST.items():
        value = os.environ.get(name) or '0'
        if not value.isdecimal() or int(value) > most:
            raise ConfigError(f'{name} = {value}: must be an integer in [0, {most}]')
    if not any(os.environ.get(name) for name in ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')):
        raise ConfigError(f'no folder for logs, as HOME is not set: {LOG_FOLDER}')
    for path in _parameter_files(words):
        try:
            document = schema.read_yaml(path)
            if document and not schema.sections_of(document):
                raise ConfigError(f'no {schema.ROS_PARAMETERS_KEY}, which {schema.FORM_OF_ROS}')
        except ConfigError as error:
            raise ConfigError(f'{path}: {error}') from error


def check_middleware() -> None:
    """Raise a ConfigError where rcl would end this process when it is imported."""
    if not (name := os.environ.get('RMW_IMPLEMENTATION')):
        return
    command = [sys.executable, '-c', 'import rclpy._rclpy_pybind11']
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and 'Traceback' not in done.stderr:
        package = f'ros-jazzy-{name.replace("_", "-")}'
        raise ConfigError(
            f'RMW_IMPLEMENTATION = {name}: is not installed here: unset it, or install {package}'
        )


def objections_of_ros(path: str | Path) -> list[str]:
    """Return why ROS's own parser refuses a parameter file; nothing where ROS is not installed."""
    check_middleware()
    try:
        with contextlib.suppress(ImportError), start_errors():
            from rclpy.utilities import remove_ros_args

            remove_ros_args(['', '--ros-args', '--params-file', str(path)])
    except ConfigError as error:
        return [str(error).rpartition('Error: ')[2]]
    return []


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
            keys = [key for key, _ in schema.sections_of(schema.read_yaml(path))]
        # Of what rclpy reads for a node, ``*`` is any word, ``**`` several; rcl has accepted the
        # rest of the keys: letters, digits, _ and / only.
        rooted = [f'/{key.removeprefix("/")}'.replace('/*', r'(/\w+)') for key in keys]
        if keys and not any(re.fullmatch(key, node_name) for key in rooted):
            lines.append(
                f'{shown(path)}: not used: its parameters are those of '
                f'{", ".join(keys)}, and this node is {node_name}; '
                'a key of /** is for every node'
            )
    return lines
