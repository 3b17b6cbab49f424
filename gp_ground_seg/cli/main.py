"""Entry point of ``gp-ground-seg``: commands, and errors mapped to exit codes."""

import argparse
import importlib
import io
import logging
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import NoReturn

from gp_ground_seg import __version__
from gp_ground_seg.core import errors

ROS_ARGS = '--ros-args'

# Module in `gp_ground_seg.cli` and purpose of each command. The `add_parser(subparsers)` of a
# module declares its commands: their options, and the default `run`, a function of the parsed
# arguments that returns an exit code. One that sets the default `accepts_ros_args` finds them in
# `ros_args`. Only the module of the command at hand is imported: all of them take a second.
COMMANDS = {
    'node': ('node', 'run the ROS 2 node'),
    'warm-up': ('node', 'compile the code before the first start'),
    'config': ('node', 'write and check parameter files'),
    'play': ('bags', "publish a bag's clouds as they were recorded"),
    'demo': ('demo', 'show the node at work, no data needed'),
    'kitti-to-bag': ('bags', 'write a KITTI sequence as a rosbag2'),
    'segment': ('segment', 'label scans, or split the clouds of a bag'),
    'plot': ('plot', 'draw a scan in perspective, or a segment of it from the side'),
    'tune': ('tune', 'set parameters by sliders, and see the labels change'),
    'evaluate': ('evaluate', 'score against SemanticKITTI labels'),
    'experiment': ('evaluate', 'repeat an experiment of docs/, such as ablation'),
}
EXAMPLES = """\
`gp-ground-seg COMMAND --help` explains a command.

examples:
  gp-ground-seg plot scan scan.pcd -o scan.png   a picture of your own scan
  gp-ground-seg demo                             the node at work, without data
  gp-ground-seg segment drive.mcap -o out.mcap   two clouds for each of a bag
  gp-ground-seg node --ros-args -r points:=/kitti/velo/pointcloud
"""


class _Parser(argparse.ArgumentParser):
    """Raises what is wrong with the words as a GroundSegError of one line."""

    def error(self, message: str) -> NoReturn:
        """Raise a GroundSegError, which names the help."""
        raise errors.GroundSegError(f'{message.removeprefix("argument ")}; see {self.prog} --help')


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of one of `COMMANDS`; without one, of all their names."""
    parser = _Parser(
        prog='gp-ground-seg',
        description='Split LiDAR scans into ground and obstacles with Gaussian processes.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--version', action='version', version=__version__)
    subparsers = parser.add_subparsers(title='commands', metavar='COMMAND', required=True)
    if command is not None:
        module = COMMANDS[command][0]
        importlib.import_module(f'gp_ground_seg.cli.{module}').add_parser(subparsers)
    else:
        for name, (_, purpose) in COMMANDS.items():
            subparsers.add_parser(name, help=purpose)
    return parser


def _parse(words: list[str]) -> argparse.Namespace:
    """Parse the words before ``--ros-args``; it and what follows is ROS's to read."""
    n_before = words.index(ROS_ARGS) if ROS_ARGS in words else len(words)
    command = next((word for word in words[:n_before] if not word.startswith('-')), None)
    parser = build_parser(command if command in COMMANDS else None)
    arguments = parser.parse_args(words[:n_before])
    arguments.ros_args = words[n_before:]
    if arguments.ros_args and not hasattr(arguments, 'accepts_ros_args'):
        raise errors.GroundSegError(f'{command}: {ROS_ARGS}: this command takes none')
    return arguments


def _notes(arguments: argparse.Namespace) -> AbstractContextManager[None]:
    """Print what the library logs as notes, except in a node, which logs by way of ROS."""
    if hasattr(arguments, 'accepts_ros_args'):
        return nullcontext()

    def note(_level: int, text: str) -> None:
        with suppress(OSError):  # standard error may be full
            print(f'gp-ground-seg: note: {errors.shown(text)}', file=sys.stderr)

    level = logging.WARNING if getattr(arguments, 'quiet', False) else logging.INFO
    return errors.messages_passed_to(note, level)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Turn Ctrl-C into KeyboardInterrupt also where numba swallows it or raises another error.

    numba does either when SIGINT comes while it compiles or loads code. SIGINT counts also where
    it is ignored at the start, as in the background of a script: `kill -INT` ends a command there.
    """
    is_interrupted = False

    def note(_number: int, _frame: object) -> None:
        nonlocal is_interrupted
        is_interrupted = True
        # Python would print the exception where it cannot be passed on.
        sys.unraisablehook = lambda _what: None
        raise KeyboardInterrupt

    before, hook = signal.signal(signal.SIGINT, note), sys.unraisablehook
    try:
        yield
    except Exception as error:
        if is_interrupted:
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = hook
    if is_interrupted:
        raise KeyboardInterrupt


def _abandon_stdout() -> None:
    """Send the rest of standard output nowhere, so that Python does not fail on it at exit."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command of `argv`, by default of the process, and return its exit code.

    It is that of the command, 2 after an error, which takes one line, or 130 when interrupted.
    """
    os.environ['MPLBACKEND'] = 'agg'  # that of a notebook need not be here; no window is opened
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors='backslashreplace')  # names of files need not be UTF-8
    try:
        try:
            with _interruptible():
                arguments = _parse(list(sys.argv[1:] if argv is None else argv))
                with _notes(arguments):
                    code: int = arguments.run(arguments)
        finally:
            print(end='', flush=True)  # also after --help, which ends by SystemExit
        return code
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        _abandon_stdout()
        return 0
    except errors.GroundSegError as error:
        line = str(error)
    except OSError as error:
        _abandon_stdout()
        line = f'{error.filename or "input or output"}: {errors.reason_of(error)}'
    except UnicodeError as error:
        line = f'{errors.in_one_line(error)}: a name or text is not UTF-8'
    except MemoryError:
        line = 'not enough memory for this input'
    except RuntimeError as error:  # of `Path.resolve`, before Python 3.13
        if not str(error).startswith('Symlink loop'):
            raise
        line = str(error)
    except KeyboardInterrupt:
        print('gp-ground-seg: interrupted', file=sys.stderr)
        return 130
    print(f'gp-ground-seg: error: {errors.shown(line)}', file=sys.stderr)
    return 2
