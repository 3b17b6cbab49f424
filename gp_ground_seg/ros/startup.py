"""Start of a ROS process, its errors in one line."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.ros.arguments import check_ros_arguments

USAGE = """\
examples:
  %(prog)s --ros-args -r points:=/kitti/velo/pointcloud
  %(prog)s --ros-args -p label.ground_tolerance:=0.15
  %(prog)s --ros-args --params-file config/vlp16.yaml
"""


def initialize(words: Sequence[str]) -> None:
    """Initialise rclpy with the words of a command line, the program's name first.

    Signal handlers are left as they are.

    Raises
    ------
    ConfigError
        If the ROS arguments or a parameter file cannot be read.
    """
    check_ros_arguments(words)
    with start_errors():
        other_words = remove_ros_args(list(words))[1:]
    parser = argparse.ArgumentParser(
        prog=words[0],
        usage='%(prog)s [--ros-args ...]',
        description='Split the clouds of a topic into ground and obstacles.',
        epilog=USAGE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.parse_args(other_words)
    with start_errors():
        rclpy.init(args=list(words), signal_handler_options=SignalHandlerOptions.NO)


@contextmanager
def start_errors() -> Iterator[None]:
    """Turn what rclpy raises at wrong arguments, names and overrides into a ConfigError."""
    try:
        yield
    except (ParameterException, NameValidationException, RuntimeError, ValueError) as error:
        raise ConfigError(_plain(error)) from error


def _plain(error: Exception) -> str:
    """Return the message of `error` in one line, without places in rcl's source."""
    text = ' '.join(str(error).split())
    if type(error).__name__ == 'UnknownROSArgsError':
        return f'unknown ROS arguments {text}'
    text = re.sub(r', at /\S+?:\d+', '', text)
    text = re.sub(r'^(failed to initialize rcl|Failed to parse ROS arguments): ', '', text)
    # rcl's tokeniser speaks of lexeme numbers.
    text = re.sub(r'Error: Expected lexeme .*', 'It must be as in -p NAME:=VALUE', text)
    if 'ros__parameters' in text:
        text += " (parameters of a file go below '/**:' and 'ros__parameters:')"
    return text
