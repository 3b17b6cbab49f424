"""Start and end of a ROS process: arguments, transport, signals.

ROS is imported by the functions that need it, so that the signals of a process can be
handled before that, which takes half a second.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import yaml

from gp_ground_seg.errors import ConfigError, GroundSegError, MissingDependencyError
from gp_ground_seg.parameters.yaml_io import load_yaml

HIGHEST_DOMAIN = 232


def initialize(words: Sequence[str]) -> None:
    """Initialise rclpy with a command line, the program's name first; no signal handlers.

    Raises a ConfigError if the ROS arguments or a parameter file cannot be read.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args

    check_surroundings(words)
    with start_errors():
        other_words = remove_ros_args(list(words))[1:]
    parser = argparse.ArgumentParser(
        prog=words[0],
        usage='%(prog)s [--ros-args ...]',
        description='Split the clouds of a topic into ground and obstacles.',
        epilog='example: %(prog)s --ros-args -r points:=/lidar --params-file vlp16.yaml',
    )
    parser.parse_args(other_words)
    with start_errors():
        rclpy.init(args=list(words), signal_handler_options=SignalHandlerOptions.NO)


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


def check_surroundings(words: Sequence[str]) -> None:
    """Raise a ConfigError for what rcl takes without a word, or ends the process for.

    These are parameter files that are not text, hold no parameters or give one twice, and a
    ``ROS_DOMAIN_ID`` for which DDS has no ports.
    """
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain.isdecimal() and int(domain) > HIGHEST_DOMAIN:
        raise ConfigError(f'ROS_DOMAIN_ID = {domain}: must be an integer in [0, {HIGHEST_DOMAIN}]')
    paths = (path for flag, path in itertools.pairwise(words) if flag == '--params-file')
    for path in paths:
        with contextlib.suppress(OSError, yaml.YAMLError, RecursionError):
            try:
                document = load_yaml(Path(path).read_text(encoding='utf-8'))
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
            "file of a ROS 2 installation, or pip install 'gp_ground_seg[ros]'"
        ) from error


# --- Transport

_PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_TRANSPORT_VARIABLES = (
    _PROFILE_VARIABLE, 'FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS',
)  # fmt: skip
MIN_SHARED_MEMORY = 128 << 20
"""Free shared memory below which the profile is not used: four segments [bytes]."""


@contextmanager
def large_cloud_transport() -> Iterator[None]:
    """Name the Fast DDS profile for large clouds, if the user has chosen none.

    It holds for this process, if ROS is used for the first time within the block, and for
    those started within it. Without it, clouds above 0.5 MB are sent in pieces, which get lost.
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
        status = os.statvfs('/dev/shm')
    except OSError:
        return 0
    return status.f_bavail * status.f_frsize


# --- Signals

GRACE = 0.5
"""Time from the signal to the end of the process, if the work does not end before [s]."""
_STOPS = (signal.SIGINT, signal.SIGTERM)
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Whether a signal to end the process has come."""

    def __init__(self) -> None:
        self.made = False

    def note(self, _number: int, _frame: FrameType | None) -> None:
        """Set `made`.

        An exception here would come out of any running code: rclpy's bindings turn it into
        another one, the compiler and destructors print and swallow it.
        """
        self.made = True


class _Watchdog:
    """Ends the process with code 0 if it does not end within `GRACE` of a signal.

    Python calls its handlers between two steps of the main thread, and the next step may be
    seconds away, behind a long computation. The number of a signal is written to a pipe at
    once, where a thread waits for it.
    """

    def __init__(self) -> None:
        self._done = threading.Event()
        self._read_end, self._write_end = os.pipe()
        os.set_blocking(self._write_end, False)
        self._before = signal.set_wakeup_fd(self._write_end, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._watch, name='signals', daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._done.set()
        signal.set_wakeup_fd(self._before)
        os.close(self._write_end)
        self._thread.join()
        os.close(self._read_end)

    def _watch(self) -> None:
        with contextlib.suppress(OSError):
            while number := os.read(self._read_end, 1):
                if number[0] in _STOPS:
                    break
        # At the end of the pipe too; then `_done` is set.
        if not self._done.wait(GRACE):
            os._exit(0)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Have SIGINT and SIGTERM within the block noted in the `StopRequest` that it yields.

    If the block does not end soon after, the process does, with code 0. After the first
    signal both stay ignored: a terminal and ``ros2 launch`` both send one, and the second
    must not break the clean-up. In other threads than the main one nothing is changed.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    watchdog = _Watchdog()
    before = {number: signal.signal(number, request.note) for number in _STOPS}
    try:
        yield request
    finally:
        if not request.made:
            _restore(before)
        watchdog.close()


def _restore(handlers: dict[signal.Signals, Any]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, signal.SIG_DFL if handler is None else handler)


class Session:
    """The node of a command, and the time it spends waiting; made by `ros_session`.

    `node` has no parameter services and does not log to /rosout.
    """

    def __init__(self, node: Any) -> None:
        from rclpy.executors import SingleThreadedExecutor

        self.node = node
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._is_interrupted = False
        self._is_held_back = False

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
        if not self._is_held_back:
            raise KeyboardInterrupt

    @contextmanager
    def holding_back(self) -> Iterator[None]:
        """Let a signal within the block be raised at the next `check` only."""
        self._is_held_back = True
        try:
            yield
        finally:
            self._is_held_back = False

    def close(self) -> None:
        """Destroy the node, which tells the network that it goes."""
        self._executor.shutdown()
        self.node.destroy_node()

    def check(self, cause: Exception | None = None) -> None:
        """Raise KeyboardInterrupt once interrupted; `cause` is the exception it came out as.

        Python swallows an exception that a signal raises within a destructor or a callback:
        long loops call this now and then.
        """
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
    from rclpy.signals import SignalHandlerOptions

    check_surroundings(ros_args)
    context = Context()
    with start_errors():
        options = SignalHandlerOptions.NO
        rclpy.init(args=[name, *ros_args], context=context, signal_handler_options=options)
    try:
        with start_errors():
            node = rclpy.create_node(
                name, context=context, start_parameter_services=False, enable_rosout=False
            )
        session = Session(node)
        try:
            with _signals_to(session):
                yield session
        finally:
            session.close()
    finally:
        rclpy.try_shutdown(context=context)


@contextmanager
def _signals_to(session: Session) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # What is ignored on purpose, as by nohup, stays so.
    heeded = [number for number in _INTERRUPTS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, session.interrupt) for number in heeded}
    try:
        yield
    except Exception as error:
        # An interrupt within rclpy's bindings may come out of them as another exception.
        session.check(error)
        raise
    finally:
        _restore(before)
