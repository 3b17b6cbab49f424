"""Entry point of ``gp-ground-seg``: commands, and errors mapped to exit codes."""

from __future__ import annotations

import argparse
import gc
import importlib
import io
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, NoReturn, TextIO

from gp_ground_seg import __version__
from gp_ground_seg.core.errors import GroundSegError, in_one_line, reason_of, shown
from gp_ground_seg.core.parameters.schema import did_you_mean

ROS_ARGS = '--ros-args'
OF_ROS = ('-r', '--remap', '-p', '--param', '--params-file', '--log-level')
"""Options that ROS reads, behind `ROS_ARGS`."""
COLLECT_AFTER = 50_000
"""New objects after which Python looks for garbage: compiling makes a million that stay, and with
the usual 700 a tenth of its time goes into the search."""

# Module in `gp_ground_seg.cli` and purpose of each command. The `add_parser(subparsers)` of a
# module declares its commands: their options, and the default `run`, a function of the parsed
# arguments that returns an exit code. One that sets the default `accepts_ros_args` finds them in
# `ros_args`. Only the module of the command at hand is imported: all of them take a second.
COMMANDS = {
    'node': ('node', 'run the ROS 2 node'),
    'warm-up': ('node', 'compile the code before the first start'),
    'config': ('config', 'write, check and compare parameter files'),
    'play': ('bags', "publish a bag's clouds as they were recorded"),
    'demo': ('demo', 'show the node at work, no data needed'),
    'kitti-to-bag': ('bags', 'write a KITTI sequence as a rosbag2'),
    'segment': ('segment', 'label scans, or split the clouds of a bag'),
    'plot': ('plot', 'draw a scan in perspective, or a segment of it from the side'),
    'tune': ('tune', 'set parameters by sliders, and see the labels change'),
    'evaluate': ('evaluate', 'score against SemanticKITTI labels'),
    'experiment': ('experiment', 'repeat an experiment of docs/, such as ablation'),
}
FILE_COMMANDS = {'plot': 'scan', 'config': 'check'}
"""Of the commands below a command, which is meant where a file stands in its place."""
GROUPS = {'robot': 'node', 'files': 'segment', 'laboratory': 'evaluate'}
"""Groups of commands in the help, each with its first command."""

EXAMPLES = """\
examples:
  gp-ground-seg demo                             show the node at work, no data needed
  gp-ground-seg segment drive.mcap -o out.mcap   ground and obstacle clouds of a bag
  gp-ground-seg evaluate KITTI_ROOT --sequences 00,08
  gp-ground-seg node --ros-args -r points:=/kitti/velo/pointcloud
"""


def _grouped_commands() -> str:
    """Return a line for each command, under the title of its group."""
    titles = {first: title for title, first in GROUPS.items()}
    lines = []
    for name, (_, purpose) in COMMANDS.items():
        if name in titles:
            lines.append(f'{titles[name]}:')
        lines.append(f'  {name:<14}{purpose}')
    return '\n'.join(lines)


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, the same with every version of Python."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.options: dict[str, argparse.Action] = {}
        self.commands: dict[str, argparse.ArgumentParser] = {}
        super().__init__(*args, **kwargs)

    def add_argument(self, *args: Any, **kwargs: Any) -> argparse.Action:
        """Note the names of an option."""
        action = super().add_argument(*args, **kwargs)
        self.options.update(dict.fromkeys(action.option_strings, action))
        return action

    def add_subparsers(self, **kwargs: Any) -> Any:
        """Note the commands below this one."""
        subparsers = super().add_subparsers(**kwargs)
        self.commands = subparsers.choices
        return subparsers

    def error(self, message: str) -> NoReturn:
        """Raise a GroundSegError, which names the help if the message has no next step."""
        has_step = 'must be' in message or 'did you mean' in message
        parts = [self.prog.partition(' ')[2], message.removeprefix('argument ')]
        hint = '' if has_step else f'; {self.prog} --help lists what it takes'
        raise GroundSegError(': '.join(filter(None, parts)) + hint)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse what is no command, and, in the parser of the last one, what it does not take."""
        words = sys.argv[1:] if args is None else args
        command = next((word for word in words if not word.startswith('-')), None)
        if self.commands and command is not None and command not in self.commands:
            self._refuse_command(command)
        arguments, unknown = super().parse_known_args(words, namespace)
        if unknown and not self.commands:
            hint = self._hint_at(unknown[0], words)
            self.error(f'unrecognized arguments: {" ".join(unknown)}{hint}')
        return arguments, unknown

    def _refuse_command(self, word: str) -> NoReturn:
        """Say which command below this one a word may mean that is none."""
        file_command = FILE_COMMANDS.get(self.prog.split()[-1])
        if word and file_command and (Path(word).suffix or Path(word).exists()):
            self.error(f'{word}: no command; did you mean {self.prog} {file_command} {word}?')
        names = ', '.join(self.commands)
        self.error(f'{word!r}: must be one of {names}{did_you_mean(word, self.commands)}')

    def _hint_at(self, word: str, words: Sequence[str]) -> str:
        """Say what may be meant by one of the words, which is not taken."""
        if word in OF_ROS and self.get_default('accepts_ros_args'):
            return f'; did you mean {ROS_ARGS} {word}?'
        if word.startswith('-'):
            return did_you_mean(word.partition('=')[0], self.options) if word[1:2] == '-' else ''
        # Of a list with spaces only the first word belongs to its option.
        *_, option = ['', *(w for w in words[: words.index(word)] if w.startswith('-'))]
        is_list = {name: re.search('LIST|,', f'{a.metavar}') for name, a in self.options.items()}
        if option and any(is_list[name] for name in is_list if name.startswith(option)):
            first, second = words[words.index(option) + 1 :][:2]
            given = f'{option} {first.strip(",")},{second}'
            return f'; the list must be without spaces, as in {given}'
        return ''


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of one of `COMMANDS`; without one, of all their names."""
    parser = _Parser(
        prog='gp-ground-seg',
        description='Split LiDAR scans into ground and obstacles with Gaussian processes.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--version', action='version', version=__version__)
    subparsers = parser.add_subparsers(
        title='commands',
        description=_grouped_commands(),
        metavar='COMMAND',
        help='explained by `gp-ground-seg COMMAND --help`',
        required=True,
    )
    if command is not None:
        module = COMMANDS[command][0]
        importlib.import_module(f'gp_ground_seg.cli.{module}').add_parser(subparsers)
    else:
        for name in COMMANDS:
            subparsers.add_parser(name)
    return parser


def _parse(words: list[str]) -> argparse.Namespace:
    """Parse the words before ``--ros-args``; it and what follows is ROS's to read."""
    n_before = words.index(ROS_ARGS) if ROS_ARGS in words else len(words)
    command = next((word for word in words[:n_before] if not word.startswith('-')), None)
    if command not in (None, *COMMANDS):
        hint = did_you_mean(command or '', COMMANDS) or '; --help lists them'
        raise GroundSegError(f'{command}: no such command{hint}')
    parser = build_parser(command if command in COMMANDS else None)
    arguments = parser.parse_args(words[:n_before])
    arguments.ros_args = words[n_before:]
    if arguments.ros_args and not getattr(arguments, 'accepts_ros_args', False):
        raise GroundSegError(f'{command}: {ROS_ARGS}: this command takes none')
    return arguments


def _notes(arguments: argparse.Namespace) -> AbstractContextManager[None]:
    """Print what the library logs as notes, except in a node, which logs by way of ROS."""
    if getattr(arguments, 'accepts_ros_args', False):
        return nullcontext()
    from gp_ground_seg.cli.options import library_notes

    quiet = getattr(arguments, 'quiet', False)
    return library_notes(logging.WARNING if quiet else logging.INFO)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Turn Ctrl-C into KeyboardInterrupt also where numba swallows it or raises another error.

    numba does either when SIGINT comes while it compiles or loads code. SIGINT counts also where
    it is ignored at the start, as in the background of a script: `kill -INT` ends a command there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
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


def _prepare_streams() -> None:
    """Open the null device for standard streams that are closed; escape what they cannot hold.

    `print` to a closed stderr would go to stdout, and the next file opened would be the stream.
    """
    for name in ('stdin', 'stdout', 'stderr'):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, 'r' if name == 'stdin' else 'w'))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors='backslashreplace')


def _abandon(stream: TextIO) -> None:
    """Send the rest of a standard stream nowhere, so that Python does not fail on it at exit."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _run(words: list[str]) -> int:
    """Run the command; raise what it raises, or what standard output does at its end."""
    try:
        with _interruptible():
            arguments = _parse(words)
            if not getattr(arguments, 'accepts_ros_args', False):  # a node runs for days
                gc.set_threshold(COLLECT_AFTER)
            with _notes(arguments):
                code: int = arguments.run(arguments)
    finally:
        sys.stdout.flush()  # also behind --help, which ends by SystemExit
    return code


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command of `argv`, by default of the process, and return its exit code.

    It is that of the command, 2 after an error, which takes one line, or 130 when interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    _prepare_streams()
    try:
        return _code_of(words)
    finally:
        try:
            sys.stderr.flush()
        except OSError:  # it is full: what it still holds would make the exit code 120
            _abandon(sys.stderr)


def _code_of(words: list[str]) -> int:
    """Run the command, say in one line what is wrong, and return the exit code."""
    code = 2
    try:
        return _run(words)
    except BrokenPipeError:
        # The reader of our output went away (as in `| head`); nothing is wrong here.
        _abandon(sys.stdout)
        return 0
    except GroundSegError as error:
        line = f'error: {error}'
    except OSError as error:
        _abandon(sys.stdout)
        line = f'error: {error.filename or "input or output"}: {reason_of(error)}'
    except UnicodeError as error:
        line = f'error: {in_one_line(error)}: a name or text is not UTF-8'
    except MemoryError:
        line = 'error: not enough memory for this input'
    except KeyboardInterrupt:
        line, code = 'interrupted', 130
    except RuntimeError as error:
        # Of `Path.resolve`, before Python 3.13.
        if not str(error).startswith('Symlink loop'):
            raise
        line = f'error: {error}'
    with suppress(OSError):  # standard error may be full
        print(f'gp-ground-seg: {shown(line)}', file=sys.stderr)
    return code
