"""A process that uses ROS: signals and node of a command, transport of large clouds.

Functions import ROS, which takes half a second, themselves: signals are noted meanwhile, and
commands import this module where there is no ROS.
"""

import contextlib
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from gp_ground_seg.core.errors import GroundSegError, MissingDependencyError, install_hint
from gp_ground_seg.ros.arguments import check_middleware, initialize, start_errors

ROS_WHEELS = "'ros-jazzy-rclpy[fastrtps]' ros-jazzy-common-interfaces ros-jazzy-rmw-fastrtps-cpp"
_STOPS = (signal.SIGINT, signal.SIGTERM)
_PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_TRANSPORT_VARIABLES = (
    _PROFILE_VARIABLE, 'FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS',
)  # fmt: skip
MIN_SHARED_MEMORY = 128 << 20  # four segments of the profile [bytes]


@contextmanager
def needing_ros(command: str) -> Iterator[None]:
    """Turn a failed import of ROS within the block into a MissingDependencyError."""
    try:
        check_middleware()
        yield
    except ImportError as error:
        if isinstance(error, GroundSegError) or (error.name or '').startswith('gp_ground_seg'):
            raise
        raise MissingDependencyError(
            f'{command} needs ROS 2, which cannot be imported ({error}): source the setup '
            f'file of a ROS 2 installation, or {install_hint(ROS_WHEELS)}'
        ) from error


class StopRequest:
    """Whether a signal to end the process has come."""

    made = ends_process = False

    def note(self, _number: int, _frame: FrameType | None) -> None:
        """Set `made`; an exception could interrupt any code, or be swallowed by it."""
        self.made = True
        if self.ends_process:
            os._exit(0)


@contextmanager
def stop_on_signals(numbers: Iterable[signal.Signals] = _STOPS) -> Iterator[StopRequest]:
    """Yield a `StopRequest` that notes whether one of the signals `numbers` comes in the block.

    After the first signal all of them stay ignored: a terminal and ``ros2 launch`` both send one,
    and the second must not break the clean-up. In a thread that is not the main one, signals are
    left as they are.
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

    Every method that waits raises KeyboardInterrupt once `stop` is made.
    """

    def __init__(self, node: Any, stop: StopRequest) -> None:
        from rclpy.executors import SingleThreadedExecutor

        self.node = node
        self._stop = stop
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)

    def check(self) -> None:
        """Raise it; for loops that wait for nothing."""
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

    def wait_for(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Handle messages until `condition` holds, `seconds` at most; return whether it does."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            self.spin(0.02)
        return True

    def publisher_of_clouds(self, topic: str, depth: int) -> Any:
        """Return a reliable publisher, which takes messages and their bytes."""
        from sensor_msgs.msg import PointCloud2

        return self.node.create_publisher(PointCloud2, topic, depth)

    def publisher_of_time(self) -> Callable[[int], None]:
        """Return what sends a time [ns] on /clock."""
        from rclpy.time import Time
        from rosgraph_msgs.msg import Clock

        publisher = self.node.create_publisher(Clock, '/clock', 1)
        return lambda now: publisher.publish(Clock(clock=Time(nanoseconds=now).to_msg()))

    def wait_until_delivered(self, publisher: Any, seconds: float) -> bool:
        """Return whether each reliable subscriber acknowledges all messages within `seconds`."""
        from rclpy.duration import Duration

        return self.wait_for(lambda: publisher.wait_for_all_acked(Duration()), seconds)

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

    context = Context()
    initialize([name, *ros_args], context)
    # A signal that is ignored on purpose, as by nohup, stays ignored.
    heeded = [n for n in (*_STOPS, signal.SIGHUP) if signal.getsignal(n) != signal.SIG_IGN]
    try:
        with start_errors():
            node = rclpy.create_node(
                name, context=context, start_parameter_services=False, enable_rosout=False
            )
        with stop_on_signals(heeded) as stop, contextlib.closing(Session(node, stop)) as session:
            yield session
            session.check()
    finally:
        rclpy.try_shutdown(context=context)


@contextmanager
def large_cloud_transport() -> Iterator[None]:
    """Set the Fast DDS profile for large clouds in the environment, unless the user has set one.

    ROS reads it when it is first used, in the block; so do child processes. Without the profile,
    parts of clouds above 0.5 MB are lost.
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
