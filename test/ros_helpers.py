"""Real nodes, real DDS: what the ROS tests share."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
import warnings
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

with warnings.catch_warnings():
    # Type support is imported at the first use of a message; its parser, lark, imports a
    # deprecated module of Python, and warnings are errors here.
    warnings.simplefilter('ignore', DeprecationWarning)
    import rosidl_generator_py  # noqa: F401

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField

from gp_ground_seg.backend import choose_backend
from gp_ground_seg.ros.node import GroundSegmentationNode, main
from gp_ground_seg.ros.warm_up import CHANGED, FOLLOWS

PATIENCE = 120.0
"""Time to wait for what has to happen [s]; only a failure takes that long."""

# Other tests run beside this one; nothing of them must be heard here.
DOMAIN_ID = 1 + os.getpid() % 100
NAMESPACE = f'/test_{os.getpid()}'
ISOLATION = {
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    'ROS_DOMAIN_ID': str(DOMAIN_ID),
    'RCUTILS_COLORIZED_OUTPUT': '0',
}

RELIABLE = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)


def wait_for(condition: Callable[[], bool], what: str, timeout: float = PATIENCE) -> None:
    """Return as soon as `condition` holds; fail if it does not within `timeout` seconds."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            raise AssertionError(f'after {timeout:g} s still no {what}')
        time.sleep(0.005)


@contextlib.contextmanager
def isolated_context(args: list[str] | None = None) -> Iterator[Context]:
    """A context of our own domain, on this machine only."""
    before = {name: os.environ.get(name) for name in ISOLATION}
    os.environ.update(ISOLATION)
    context = Context()
    try:
        rclpy.init(context=context, args=args or [], domain_id=DOMAIN_ID)
        yield context
    finally:
        rclpy.try_shutdown(context=context)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def spinning(context: Context, *nodes: Node) -> Iterator[SingleThreadedExecutor]:
    """Spin `nodes` in a thread, then destroy them; an exception of a callback is raised here."""
    executor = SingleThreadedExecutor(context=context)
    for node in nodes:
        executor.add_node(node)
    errors: list[BaseException] = []
    done = threading.Event()

    # executor.spin() would have to be ended by a shutdown from this thread, which takes
    # a handle away that a callback just finishing still triggers.
    def spin() -> None:
        try:
            while context.ok() and not done.is_set():
                executor.spin_once(timeout_sec=0.05)
        except ExternalShutdownException:
            pass
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield executor
    finally:
        done.set()
        thread.join()
        executor.shutdown()
        for node in nodes:
            node.destroy_node()
    if errors:
        raise errors[0]


class Collector:
    """Keeps the messages of a topic."""

    def __init__(self, node: Node, message_type: type, topic: str, qos: QoSProfile = RELIABLE):
        self.messages: list = []
        self.subscription = node.create_subscription(
            message_type, topic, self.messages.append, qos
        )

    def wait(self, count: int) -> list:
        wait_for(lambda: len(self.messages) >= count, f'message {count} on {self.topic}')
        return self.messages

    @property
    def topic(self) -> str:
        return self.subscription.topic_name

    @property
    def n_publishers(self) -> int:
        return self.subscription.get_publisher_count()


def parameter_message(name: str, value: object) -> ParameterMessage:
    return Parameter(name, value=value).to_parameter_msg()


POINT = np.dtype(
    {
        'names': ['intensity', 'x', 'y', 'z', 'ring', 'time'],
        'formats': ['<f4', '<f4', '<f4', '<f4', '<u2', '<f8'],
        'offsets': [0, 4, 8, 12, 16, 24],
        'itemsize': 64,
    }
)
"""A point as a driver sends it: x not first, gaps, further fields."""

_CODES = {'f4': PointField.FLOAT32, 'f8': PointField.FLOAT64, 'u2': PointField.UINT16}


def street(n_points: int, seed: int = 0, n_invalid: int = 0) -> np.ndarray:
    """Level ground 1.73 m below the sensor with walls and poles on it, as structured points."""
    rng = np.random.default_rng(seed)
    points = np.zeros(n_points, POINT)
    # Every byte means something, also those between the fields.
    points.view(np.uint8)[:] = rng.integers(0, 256, n_points * POINT.itemsize, dtype=np.uint8)
    radius = rng.uniform(3.0, 40.0, n_points)
    azimuth = rng.uniform(-np.pi, np.pi, n_points)
    z = -1.73 + rng.normal(0.0, 0.02, n_points)
    is_wall = rng.random(n_points) < 0.3
    radius[is_wall] = rng.choice([8.0, 15.0, 25.0], is_wall.sum())
    z[is_wall] = rng.uniform(-1.0, 1.0, is_wall.sum())
    points['x'], points['y'], points['z'] = radius * np.cos(azimuth), radius * np.sin(azimuth), z
    invalid = rng.choice(n_points, n_invalid, replace=False)
    points['z'][invalid] = rng.choice([np.nan, np.inf, -np.inf], n_invalid)
    return points


def to_message(
    points: np.ndarray, stamp: tuple[int, int] = (0, 0), frame: str = ''
) -> PointCloud2:
    """Message of structured points."""
    message = PointCloud2()
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    message.header.frame_id = frame
    message.height, message.width = 1, len(points)
    message.fields = [
        PointField(name=name, offset=offset, datatype=_CODES[kind.str[1:]], count=1)
        for name, (kind, offset) in points.dtype.fields.items()
    ]
    message.point_step = points.dtype.itemsize
    message.row_step = points.nbytes
    data = array('B')
    data.frombytes(points.tobytes())
    message.data = data
    return message


def xyz_of(points: np.ndarray) -> np.ndarray:
    """Coordinates of structured points, (N, 3) float32."""
    return np.stack([points[axis] for axis in 'xyz'], axis=-1)


def rows_of(message: PointCloud2) -> list[bytes]:
    """The bytes of each point of an unorganised cloud."""
    data, step = bytes(message.data), message.point_step
    return [data[start : start + step] for start in range(0, len(data), step)]


ENTRY_POINT = ('-c', 'import sys; from gp_ground_seg.cli.node import main; sys.exit(main())')
"""What the installed executable does."""
MODULE = ('-m', 'gp_ground_seg', 'node')
PLAY = ('-m', 'gp_ground_seg', 'play')


class Process:
    """The node in a process of its own, as a user starts it."""

    def __init__(
        self,
        *words: str,
        folder: Path,
        start: tuple[str, ...] = ENTRY_POINT,
        command: list[str] | None = None,
        **environment: str,
    ) -> None:
        self._log = folder / f'node_{time.monotonic_ns()}.log'
        with self._log.open('wb') as log:
            self.popen = subprocess.Popen(
                command or [sys.executable, *start, *words],
                stdout=subprocess.DEVNULL,
                stderr=log,
                env={**os.environ, **ISOLATION, **environment},
            )

    @property
    def log(self) -> str:
        """What it wrote to stderr so far."""
        return self._log.read_text()

    def wait_until_ready(self) -> None:
        self._wait_for_log('listening to')

    def wait_until_settled(self) -> None:
        """Wait until it has the backend that it keeps: labels may differ by one or two."""
        self.wait_until_ready()
        if FOLLOWS in self.log:
            self._wait_for_log(CHANGED)

    def _wait_for_log(self, text: str) -> None:
        wait_for(
            lambda: text in self.log or self.popen.poll() is not None, f'{text!r} of the node'
        )
        assert self.popen.poll() is None, self.log

    def stop(self, number: int) -> tuple[int, float]:
        """Send a signal; return exit code and seconds until the end."""
        start = time.monotonic()
        self.popen.send_signal(number)
        code = self.popen.wait(PATIENCE)
        return code, time.monotonic() - start

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_error: object) -> None:
        if self.popen.poll() is None:
            self.popen.terminate()
            try:
                self.popen.wait(10.0)
            except subprocess.TimeoutExpired:
                self.popen.kill()
                self.popen.wait()


IsWanted = Callable[[dict[str, str], DiagnosticStatus], bool]
"""Of the values of a status, and the status."""


def wait_for_status(
    diagnostics: Collector, node_name: str, task: str, is_wanted: IsWanted
) -> DiagnosticStatus:
    """Return the first status of a node's `task`, from now on, that is wanted."""
    start = len(diagnostics.messages)
    found: list[DiagnosticStatus] = []
    name = f'{node_name[1:]}: {task}'

    def look() -> bool:
        for array_message in diagnostics.messages[start:]:
            for status in array_message.status:
                if status.name == name and is_wanted(values_of(status), status):
                    found.append(status)
                    return True
        return False

    wait_for(look, f'wanted status of {name}')
    return found[0]


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """The numbers of a status."""
    return {entry.key: entry.value for entry in status.values}


class Link:
    """What this process sends to the node of another process, and gets back from it."""

    def __init__(self, context: Context, qos: QoSProfile = RELIABLE) -> None:
        self.probe = Node('probe', context=context, namespace=NAMESPACE)
        self.publisher = self.probe.create_publisher(PointCloud2, 'points', qos)
        self.ground = Collector(self.probe, PointCloud2, 'ground')
        self.obstacles = Collector(self.probe, PointCloud2, 'obstacles')

    def wait_until_connected(self) -> None:
        wait_for(lambda: self.publisher.get_subscription_count() == 1, 'subscription')
        for collector in (self.ground, self.obstacles):
            wait_for(lambda c=collector: c.n_publishers == 1, f'publisher of {collector.topic}')


class Bench:
    """The node under test in this process, and a probe that talks to it.

    Attributes
    ----------
    node, probe : Node
        Both spin in a thread.
    publisher : Publisher
        Reliable, on ``points``.
    ground, obstacles, diagnostics : Collector
        What the node said.
    """

    def __init__(self, context: Context, words: tuple[str, ...]) -> None:
        cli_args = ['--ros-args', *words]
        self.node = GroundSegmentationNode(
            context=context, namespace=NAMESPACE, cli_args=cli_args, use_global_arguments=False
        )
        self.probe = Node('probe', context=context, namespace=NAMESPACE)
        self.publisher = self.probe.create_publisher(PointCloud2, 'points', RELIABLE)
        self.ground = Collector(self.probe, PointCloud2, 'ground')
        self.obstacles = Collector(self.probe, PointCloud2, 'obstacles')
        self.diagnostics = Collector(self.probe, DiagnosticArray, '/diagnostics')
        self._clients: dict[str, Client] = {}

    def wait_until_connected(self) -> None:
        wait_for(lambda: self.publisher.get_subscription_count() == 1, 'subscription')
        for collector in (self.ground, self.obstacles, self.diagnostics):
            wait_for(lambda c=collector: c.n_publishers == 1, f'publisher of {collector.topic}')
        # With the backend that it keeps: labels may differ by one or two.
        has_to_load = choose_backend(self.node.config.runtime.backend) == 'numba'
        wait_for(lambda: self.node._is_compiled or not has_to_load, 'compiled backend')

    def in_executor(self, function: Callable[..., object], *arguments: object) -> object:
        """Result of a call made between two waits, where entities may safely go."""
        task = self.node.executor.create_task(function, *arguments)
        wait_for(task.done, 'turn of the executor')
        return task.result()

    def segment(self, *messages: PointCloud2) -> tuple[PointCloud2, PointCloud2]:
        """Publish clouds; return the outputs of the last one."""
        count = len(self.ground.messages) + len(messages)
        for message in messages:
            self.publisher.publish(message)
        return self.ground.wait(count)[-1], self.obstacles.wait(count)[-1]

    def set(self, name: str, value: object) -> SetParametersResult:
        """Result of ``ros2 param set``."""
        request = SetParameters.Request(parameters=[parameter_message(name, value)])
        return self.call(SetParameters, 'set_parameters', request).results[0]

    def call(self, service_type: type, name: str, request: object) -> Any:
        """Response of a service of the node."""
        if name not in self._clients:
            full_name = f'{self.node.get_name()}/{name}'
            self._clients[name] = self.probe.create_client(service_type, full_name)
            wait_for(self._clients[name].service_is_ready, f'service {full_name}')
        future = self._clients[name].call_async(request)
        wait_for(future.done, f'answer of {name}')
        return future.result()

    def wait_for_status(self, task: str, is_wanted: IsWanted) -> DiagnosticStatus:
        """Return the first status of `task`, from now on, that is wanted."""
        return wait_for_status(
            self.diagnostics, self.node.get_fully_qualified_name(), task, is_wanted
        )


@contextlib.contextmanager
def bench(*words: str) -> Iterator[Bench]:
    """A connected `Bench`, the node started with ``--ros-args words``."""
    with isolated_context() as context:
        result = Bench(context, words)
        with spinning(context, result.node, result.probe):
            result.wait_until_connected()
            yield result


def start_error(capfd: pytest.CaptureFixture[str], *words: str) -> str:
    """Line that the node ends with when it refuses to start with ``--ros-args words``."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in ISOLATION.items():
            patch.setenv(name, os.environ.get(name, value) if name == 'ROS_DOMAIN_ID' else value)
        assert main(['--ros-args', *words]) == 2
    said = capfd.readouterr()
    assert said.out == ''
    assert 'Traceback' not in said.err
    line = said.err.splitlines()[-1]
    assert line.startswith('ground_segmentation_node: error: ')
    return line
