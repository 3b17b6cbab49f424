"""Start and end of a ROS process: arguments, transport, signals.

Functions import ROS themselves, which takes half a second: signals are handled meanwhile.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import yaml

from gp_ground_seg.core.errors import (
    ConfigError,
    GroundSegError,
    MissingDependencyError,
    install_hint,
)
from gp_ground_seg.core.parameters.schema import read_yaml

HIGHEST_DOMAIN = 232
ROS_WHEELS = "'ros-jazzy-rclpy[fastrtps]' ros-jazzy-common-interfaces ros-jazzy-rmw-fastrtps-cpp"


def initialize(words: Sequence[str]) -> None:
    """Initialise rclpy with a command line; raises a ConfigError if that cannot be read."""
    from rclpy.utilities import remove_ros_args

    _check_surroundings(words)
    with start_errors():
        other_words = remove_ros_args(list(words))[1:]
    parser = argparse.ArgumentParser(
        prog=words[0],
        usage='%(prog)s [--ros-args ...]',
        description='Split the clouds of a topic into ground and obstacles.',
        epilog='example: %(prog)s --ros-args -r points:=/lidar --params-file my.yaml',
    )
    parser.parse_args(other_words)
    _init(words)


def _init(words: Sequence[str], context: Any = None) -> None:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

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
        text = ' '.join(str(error).split())
        kind = type(error).__name__
        raise ConfigError(text if kind == 'RCLError' else f'{kind}: {text}') from error


def _check_surroundings(words: Sequence[str]) -> None:
    """Raise a ConfigError for what rcl takes without a word, or ends the process for."""
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain.isdecimal() and int(domain) > HIGHEST_DOMAIN:
        raise ConfigError(f'ROS_DOMAIN_ID = {domain}: must be an integer in [0, {HIGHEST_DOMAIN}]')
    for path in (path for flag, path in itertools.pairwise(words) if flag == '--params-file'):
        with contextlib.suppress(OSError, yaml.YAMLError, RecursionError):
            try:
                document = read_yaml(path)
            except (UnicodeDecodeError, ConfigError) as error:
                raise ConfigError(f'{path}: {error}') from error
            if not isinstance(document, dict | None):
                raise ConfigError(f'{path}: no ros__parameters')


@contextmanager
def needing_ros(command: str) -> Iterator[None]:
    """Turn a failed import of ROS within the block into a MissingDependencyError."""
    try:
        yield
    except ImportError as error:
        if isinstance(error, GroundSegError) or (error.name or '').startswith('gp_ground_seg'):
            raise
        raise MissingDependencyError(
            f'{command} needs ROS 2, which cannot be imported ({error}): source the setup '
            f'file of a ROS 2 installation, or {install_hint(ROS_WHEELS)}'
        ) from error


def own_code(code: str) -> str:
    """Code for ``python -c`` that imports nothing from the current folder, which may be any."""
    path = [entry for entry in sys.path if os.path.isabs(entry)]
    return f'import sys\nsys.path[:] = {path!r}\n{code}'


_PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_TRANSPORT_VARIABLES = (
    _PROFILE_VARIABLE, 'FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS',
)  # fmt: skip
MIN_SHARED_MEMORY = 128 << 20  # four segments of the profile [bytes]


@contextmanager
def large_cloud_transport() -> Iterator[None]:
    """Name the Fast DDS profile for large clouds to ROS, first used in the block, and children.

    Unless the user has chosen one. Without it, clouds above 0.5 MB lose pieces on the way.
    """
    profile = _find_profile()
    is_chosen = any(os.environ.get(name) for name in _TRANSPORT_VARIABLES)
    if is_chosen or profile is None or _free_shared_memory() < MIN_SHARED_MEMORY:
        yield
        return
    os.environ[_PROFILE_VARIABLE] = str(profile)
    try:
        yield
    finally:
        del os.environ[_PROFILE_VARIABLE]


def _find_profile() -> Path | None:
    """Return config/fastdds_large_clouds.xml of a checkout, or as pip and colcon install it."""
    parents = Path(__file__).resolve().parents
    folders = [parents[2] / 'config', *(p / 'share/gp_ground_seg/config' for p in parents)]
    files = (folder / 'fastdds_large_clouds.xml' for folder in folders)
    return next((file for file in files if file.is_file()), None)


def _free_shared_memory() -> int:
    try:
        return shutil.disk_usage('/dev/shm').free
    except OSError:
        return 0


GRACE = 0.5  # time from the signal to the end of the process, if the work does not end before [s]
_STOPS = (signal.SIGINT, signal.SIGTERM)
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Whether a signal to end the process has come."""

    made = False

    def note(self, _number: int, _frame: FrameType | None) -> None:
        """Set `made`; an exception would come out of any running code, or be swallowed there."""
        self.made = True


@contextmanager
def _watchdog() -> Iterator[None]:
    """End the process with code 0 if the block does not end within `GRACE` of a signal."""
    # Python calls its handlers between two steps of the main thread, and the next may be seconds
    # away. The number of a signal is written to a pipe at once, where a thread waits for it.
    done = threading.Event()
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)

    def watch() -> None:
        with contextlib.suppress(OSError):
            while number := os.read(read_end, 1):
                if number[0] in _STOPS:
                    break
        # At the end of the pipe too; then `done` is set.
        if not done.wait(GRACE):
            os._exit(0)

    before = signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    thread = threading.Thread(target=watch, name='signals', daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        signal.set_wakeup_fd(before)
        os.close(write_end)
        thread.join()
        os.close(read_end)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Have SIGINT and SIGTERM within the block noted in the `StopRequest` that it yields.

    After the first signal both stay ignored: a terminal and ``ros2 launch`` both send one, and
    the second must not break the clean-up. In other threads than the main one nothing is changed.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    with _watchdog(), _handling(_STOPS, request.note, lambda: not request.made):
        yield request


@contextmanager
def _handling(
    numbers: Iterable[signal.Signals],
    handler: Callable[[int, FrameType | None], None],
    is_over: Callable[[], bool] = lambda: True,
) -> Iterator[None]:
    """Handle signals within the block; the handlers before are back after it if `is_over`."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items() if is_over() else ():
            signal.signal(number, signal.SIG_DFL if earlier is None else earlier)


class Session:
    """The node of a command, without services and /rosout, and the time it spends waiting."""

    _is_interrupted = False

    def __init__(self, node: Any) -> None:
        from rclpy.executors import SingleThreadedExecutor

        self.node = node
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)

    def sleep(self, seconds: float) -> None:
        """Wait without handling messages; as exact as the system's clock is."""
        time.sleep(seconds)
        self.check()

    def spin(self, seconds: float) -> None:
        """Handle one message, or wait that long for it."""
        self._executor.spin_once(timeout_sec=seconds)
        self.check()

    def interrupt(self, _number: int, _frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, now and at the next wait."""
        self._is_interrupted = True
        raise KeyboardInterrupt

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self.node.destroy_node()

    def check(self, cause: Exception | None = None) -> None:
        """Raise KeyboardInterrupt once interrupted; `cause` is what the interrupt came out as."""
        # Python swallows what a signal raises within a destructor: long loops call this.
        if self._is_interrupted:
            raise KeyboardInterrupt from cause


@contextmanager
def ros_session(name: str, ros_args: Sequence[str] = ()) -> Iterator[Session]:
    """Yield a `Session` whose node is called `name`, in a context of its own.

    SIGINT, SIGTERM and SIGHUP, unless ignored, interrupt the block. `ros_args` is
    ``--ros-args`` and what follows it; raises a ConfigError if that cannot be read.
    """
    import rclpy
    from rclpy.context import Context

    _check_surroundings(ros_args)
    context = Context()
    _init([name, *ros_args], context)
    try:
        with start_errors():
            node = rclpy.create_node(
                name, context=context, start_parameter_services=False, enable_rosout=False
            )
        is_main = threading.current_thread() is threading.main_thread()
        # What is ignored on purpose, as by nohup, stays so.
        heeded = [n for n in _INTERRUPTS if is_main and signal.getsignal(n) != signal.SIG_IGN]
        with (
            contextlib.closing(Session(node)) as session,
            _handling(heeded, session.interrupt),
        ):
            try:
                yield session
            except Exception as error:
                # An interrupt within rclpy's bindings may come out of them as another exception.
                session.check(error)
                raise
    finally:
        rclpy.try_shutdown(context=context)
