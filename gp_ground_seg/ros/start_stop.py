"""Start and end of a ROS process: arguments, compiled code, transport, signals.

Functions import ROS and the stages themselves, which takes half a second: signals are handled
meanwhile.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from gp_ground_seg.core.errors import (
    ConfigError,
    GroundSegError,
    MissingDependencyError,
    install_hint,
    reason_of,
    shown,
)
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import ROS_PARAMETERS_KEY, read_yaml

if TYPE_CHECKING:
    from gp_ground_seg.core.backend import Backend

HIGHEST_DOMAIN = 232
_MOST_KEYS = 10  # of a parameter file that are listed
LOG_FOLDER = 'set ROS_LOG_DIR to a folder that the node may write to'
NO_VALUE = ': a value is null or an empty list, which ROS does not read; no input.crop_box is none'
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
        # Without the places in the source code of rcl.
        text = re.sub(r', at \S+\.c:\d+', '', ' '.join(str(error).split()))
        kind = type(error).__name__
        is_of_log = text.startswith(('failed to initialize logging', 'Failed opening file'))
        text += f': {LOG_FOLDER}' if is_of_log else ''
        text += NO_VALUE if 'PARAMETER_NOT_SET' in text else ''
        raise ConfigError(text if kind == 'RCLError' else f'{kind}: {text}') from error


def _check_surroundings(words: Sequence[str]) -> None:
    """Raise a ConfigError for what rcl takes without a word, or ends the process for."""
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain.isdecimal() and int(domain) > HIGHEST_DOMAIN:
        raise ConfigError(f'ROS_DOMAIN_ID = {domain}: must be an integer in [0, {HIGHEST_DOMAIN}]')
    if not any(os.environ.get(name) for name in ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')):
        raise ConfigError(f'no folder for logs, as HOME is not set: {LOG_FOLDER}')
    for path in _parameter_files(words):
        try:
            document = read_yaml(path)
        except OSError as error:
            raise ConfigError(f'{path}: {reason_of(error)}') from error
        except (UnicodeDecodeError, ConfigError) as error:
            raise ConfigError(f'{path}: {error}') from error
        if document and not _node_keys(document):
            hint = 'gp-ground-seg config dump writes a file of the form of ROS'
            if not Config.problems_of_file(path):
                hint = (
                    'bare groups are good for --config; for the node: gp-ground-seg config dump '
                )
                hint += '--config FILE > ros.yaml'
            raise ConfigError(f'{path}: no {ROS_PARAMETERS_KEY}; {hint}')


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
        with contextlib.suppress(OSError, ConfigError):  # it was read before, and may be gone
            keys = _node_keys(read_yaml(path))
        if keys and not any(_is_of_node(key, node_name) for key in keys):
            more = [f'{len(keys) - _MOST_KEYS} more'] if len(keys) > _MOST_KEYS else []
            lines.append(
                f'{shown(path)}: not used: its parameters are those of '
                f'{", ".join([*keys[:_MOST_KEYS], *more])}, and this node is '
                f'{node_name}; a key of /** is for every node'
            )
    return lines


def _is_of_node(key: str, node_name: str) -> bool:
    """Whether rclpy gives the parameters of `key` to a node: ``*`` is any word, ``**`` several."""
    rooted = key if key.startswith('/') else f'/{key}'
    # rcl has accepted the key: there are letters, digits and _ beside them.
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


_CHILD = """\
import os, signal, sys, threading
sys.path[:] = {path!r}
# Standard input ends when the process that has started this one does.
end = lambda: (os.read(0, 1), os.kill(os.getpid(), signal.SIGTERM))
threading.Thread(target=end, daemon=True).start()
{code}
"""


def child_command(code: str) -> list[str]:
    """Return the command of a Python process that runs `code`, and ends when this one does.

    Start it with a pipe as standard input. It imports what this process does, and nothing from
    the current folder, which may be any.
    """
    path = [entry for entry in sys.path if os.path.isabs(entry)]
    return [sys.executable, '-c', _CHILD.format(path=path, code=code)]


FOLLOWS = (
    'segmenting with numpy until the compiled code is there: a second, or 20 to 60 s to compile it'
)
CHANGED = 'segmenting with numba now'
STAYS = 'segmenting with numpy from now on'
JOIN_TIMEOUT = 0.5  # longest wait for the thread [s]

# Looking for garbage less often, as the commands do, saves a tenth of the time.
_COMPILE = 'import gc; gc.set_threshold(50_000); ' + (
    'from gp_ground_seg.core.segmenter import warm_up; warm_up()'
)


class BackendLoader:
    """Makes the compiled backend in a thread, while frames are segmented without it.

    `on_done` is called there when the backend is made or cannot be made; not after `stop`.
    """

    error = ''
    seconds = 0.0
    is_ready = False
    """Whether `take_backend` has a result that was not taken yet."""
    _backend: Backend | None = None
    _is_stopped = False
    _compiler: subprocess.Popen[bytes] | None = None
    _thread: threading.Thread | None = None

    def __init__(self, on_done: Callable[[], None]) -> None:
        self._on_done = on_done
        self._lock = threading.Lock()

    @property
    def is_started(self) -> bool:
        """Whether `start` has been called."""
        return self._thread is not None

    @property
    def is_busy(self) -> bool:
        """Whether the thread runs."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, config: Config) -> None:
        """Begin to make the backend for `config`."""
        self._thread = threading.Thread(target=self._run, args=(config,), daemon=True)
        self._thread.start()

    def take_backend(self) -> Backend | None:
        """Return the backend, once; None if it cannot be made, and `error` says why."""
        backend, self._backend, self.is_ready = self._backend, None, False
        return backend

    def stop(self) -> None:
        """End the compiling process; `on_done` is not called from now on."""
        with self._lock:
            self._is_stopped = True
            if self._compiler is not None:
                self._compiler.kill()

    def close(self) -> None:
        """Stop, and wait for the thread.

        A thread that compiles in this process, as where no folder can keep the code, does so for
        20 to 60 s: nobody waits for it.
        """
        self.stop()
        if self._thread is not None:
            self._thread.join(JOIN_TIMEOUT)

    def _run(self, config: Config) -> None:
        start = time.monotonic()
        backend = None
        try:
            # What is kept is known once the compiled functions are declared.
            importlib.import_module('gp_ground_seg.core.compiled.backend')
            from gp_ground_seg.core.jit import code_folder, is_code_kept
            from gp_ground_seg.core.segmenter import warm_up

            if code_folder() is not None and not is_code_kept():
                self._compile()
            if not self._is_stopped:
                # A given height is not that of the scan which is segmented for this.
                backend = warm_up(dataclasses.replace(config, sensor=Config().sensor))
        except Exception as error:
            self.error = f'{type(error).__name__}: {error}'
        self.seconds = time.monotonic() - start
        with self._lock:
            if not self._is_stopped:
                self._backend, self.is_ready = backend, True
                self._on_done()

    def _compile(self) -> None:
        """Compile in a child process, whose memory is free after it: twice what the node needs."""
        with self._lock:
            if self._is_stopped:
                return
            pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
            self._compiler = subprocess.Popen(
                child_command(_COMPILE),
                cwd='/',
                stdin=pipe,
                stdout=nowhere,
                stderr=pipe,
            )
        with self._compiler:
            assert self._compiler.stderr is not None
            said = self._compiler.stderr.read().decode(errors='replace').strip()
            code = self._compiler.wait()
        if code and not self._is_stopped:
            reason = said.splitlines()[-1] if said else f'exit code {code}'
            raise RuntimeError(f'the compiling process failed: {reason}')


def run_node(words: Sequence[str], *, is_managed: bool = False) -> int:
    """Run a node until a signal; return its exit code, or raise where there is no ROS."""
    # Importing ROS takes most of a second; a signal within it is obeyed as well.
    with stop_on_signals() as stop:
        with needing_ros('the node'):
            node = importlib.import_module('gp_ground_seg.ros.node')
        return 0 if stop.made else node.main(words, is_managed=is_managed)


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


_STOPS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Whether a signal to end the process has come."""

    made = False

    def note(self, _number: int, _frame: FrameType | None) -> None:
        """Set `made`; an exception would come out of any running code, or be swallowed there."""
        self.made = True


@contextmanager
def stop_on_signals(numbers: Iterable[signal.Signals] = _STOPS) -> Iterator[StopRequest]:
    """Have the signals `numbers` within the block noted in the `StopRequest` that it yields.

    After the first signal all of them stay ignored: a terminal and ``ros2 launch`` both send one,
    and the second must not break the clean-up. Only the main thread can do that; in another one
    nothing is changed.
    """
    request = StopRequest()
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, request.note) for number in numbers if is_main}
    try:
        yield request
    finally:
        for number, earlier in {} if request.made else before.items():
            signal.signal(number, signal.SIG_DFL if earlier is None else earlier)


class Session:
    """The node of a command, without services and /rosout, and the time it spends waiting.

    Every method raises KeyboardInterrupt once `stop` is made.
    """

    def __init__(self, node: Any, stop: StopRequest) -> None:
        from rclpy.executors import SingleThreadedExecutor

        self.node = node
        self._stop = stop
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)

    def check(self) -> None:
        """Do nothing else; long loops call it."""
        if self._stop.made:
            raise KeyboardInterrupt

    def sleep(self, seconds: float) -> None:
        """Wait without handling messages; as exact as the system's clock is."""
        time.sleep(seconds)
        self.check()

    def spin(self, seconds: float) -> None:
        """Handle one message, or wait that long for it, 0.1 s at most."""
        self._executor.spin_once(timeout_sec=min(seconds, 0.1))
        self.check()

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self.node.destroy_node()


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
    # What is ignored on purpose, as by nohup, stays so.
    heeded = [n for n in (*_STOPS, signal.SIGHUP) if signal.getsignal(n) != signal.SIG_IGN]
    try:
        with start_errors():
            node = rclpy.create_node(
                name, context=context, start_parameter_services=False, enable_rosout=False
            )
        with (
            stop_on_signals(heeded) as stop,
            contextlib.closing(Session(node, stop)) as session,
        ):
            yield session
            session.check()
    finally:
        rclpy.try_shutdown(context=context)
