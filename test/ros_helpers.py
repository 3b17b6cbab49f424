"""Real nodes, real DDS: what the ROS tests share."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from array import array
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

with warnings.catch_warnings():
    # Type support is imported at the first use of a message; its parser, lark, imports a
    # deprecated module of Python, and warnings are errors here.
    warnings.simplefilter('ignore', DeprecationWarning)
    import rosidl_generator_py  # noqa: F401

import rclpy
from cli_runner import LOOK_PERIOD, PATIENCE, cpu_seconds, stat_words, wait_for
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField

from gp_ground_seg.core.backend import choose_backend
from gp_ground_seg.core.parameters.schema import NODE_NAME
from gp_ground_seg.data.point_cloud2 import DATATYPES
from gp_ground_seg.ros import diagnostics
from gp_ground_seg.ros.input import THROTTLED
from gp_ground_seg.ros.loader import CHANGED, FOLLOWS
from gp_ground_seg.ros.node import GroundSegmentationNode

# Other tests run beside this one, also as workers of pytest-xdist; nothing of them must be heard.
_WORKER = os.environ.get('PYTEST_XDIST_WORKER', '').removeprefix('gw')
_SESSION = os.getppid() if _WORKER else os.getpid()
NAMESPACE = f'/test_{_SESSION}'
ISOLATION = {
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    'ROS_DOMAIN_ID': str(1 + (4 * _SESSION + int(_WORKER or 0)) % 100),
    'RCUTILS_COLORIZED_OUTPUT': '0',
}
os.environ.update(ISOLATION)
# Nothing is said twice in a test, however long that takes.
THROTTLED['throttle_duration_sec'] = diagnostics.LOG_PERIOD = 600.0

RELIABLE = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)


@contextlib.contextmanager
def isolated_context():
    """A context of that domain."""
    context = Context()
    rclpy.init(context=context, args=[])
    try:
        yield context
    finally:
        rclpy.try_shutdown(context=context)


@contextlib.contextmanager
def spinning(context, *nodes):
    """Spin `nodes` in a thread, then destroy them; an exception of a callback is raised here."""
    executor = SingleThreadedExecutor(context=context)
    for node in nodes:
        executor.add_node(node)
    done = threading.Event()

    # executor.spin() would have to be ended by a shutdown from this thread, which takes
    # a handle away that a callback just finishing still triggers.
    def spin():
        with contextlib.suppress(ExternalShutdownException):
            while context.ok() and not done.is_set():
                executor.spin_once(timeout_sec=0.05)

    with ThreadPoolExecutor(1) as pool:
        spun = pool.submit(spin)
        try:
            yield
        finally:
            done.set()
            error = spun.exception()
            executor.shutdown()
            for node in nodes:
                node.destroy_node()
        if error:
            raise error


class Collector:
    """Keeps the messages of a topic."""

    def __init__(self, node, message_type, topic, qos=RELIABLE):
        self.messages = []
        take = self.messages.append
        self.subscription = node.create_subscription(message_type, topic, take, qos)

    def wait(self, count):
        what = f'message {count} on {self.subscription.topic_name}'
        wait_for(lambda: len(self.messages) >= count, what)
        return self.messages


SETTERS = {SetParameters: 'set_parameters', SetParametersAtomically: 'set_parameters_atomically'}
_LAYOUT = {'names': ['intensity', *'xyz'], 'formats': 4 * ['<f4'], 'offsets': [0, 4, 8, 12]}
POINT = np.dtype({**_LAYOUT, 'itemsize': 64})
"""A point as a driver sends it: x not first, bytes that belong to no field."""


def street(n_points, seed=0):
    """Level ground 1.73 m below the sensor with walls and poles on it, as structured points."""
    rng = np.random.default_rng(seed)
    points = np.zeros(n_points, POINT)
    # Every byte means something, also those between the fields.
    points.view(np.uint8)[:] = rng.integers(0, 256, n_points * POINT.itemsize, dtype=np.uint8)
    radius, azimuth = rng.uniform(3.0, 40.0, n_points), rng.uniform(-np.pi, np.pi, n_points)
    z = -1.73 + rng.normal(0.0, 0.02, n_points)
    is_wall = rng.random(n_points) < 0.3
    radius[is_wall] = rng.choice([8.0, 15.0, 25.0], is_wall.sum())
    z[is_wall] = rng.uniform(-1.0, 1.0, is_wall.sum())
    points['x'], points['y'], points['z'] = radius * np.cos(azimuth), radius * np.sin(azimuth), z
    return points


def moved(points, xyz):
    """Structured points at other coordinates (N, 3)."""
    for k, axis in enumerate('xyz'):
        points[axis] = xyz[:, k]
    return points


def to_message(points, stamp=(0, 0), frame=''):
    """Message of structured points."""
    message = PointCloud2(height=1, width=len(points), row_step=points.nbytes)
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    message.header.frame_id = frame
    message.fields = [
        PointField(name=name, offset=offset, datatype=DATATYPES[of.str[1:]], count=1)
        for name, (of, offset) in points.dtype.fields.items()
    ]
    message.point_step = points.dtype.itemsize
    message.data = array('B', points.tobytes())
    return message


def xyz_of(points):
    """Coordinates of structured points, (N, 3) float32."""
    return np.stack([points[axis] for axis in 'xyz'], axis=-1)


def rows_of(message):
    """The bytes of each point of an unorganised cloud."""
    data, step = bytes(message.data), message.point_step
    return [data[start : start + step] for start in range(0, len(data), step)]


_RUN = "import sys; sys.path.remove(''); from gp_ground_seg.cli.node import {0}; sys.exit({0}())"
ENTRY_POINT, MANAGED = (('-c', _RUN.format(name)) for name in ('main', 'main_managed'))
"""What the installed executables do; the first of sys.path is their folder."""
SOON = 4.0  # longest time of the cloud at hand, as `Process.time_of` has it [s]
MODULE = ('-m', 'gp_ground_seg', 'node')
IN_NAMESPACE = ('--ros-args', '-r', f'__ns:={NAMESPACE}')


PATIENT = {
    'diagnostics.period': 0.1, 'diagnostics.stale_after': 600.0, 'diagnostics.max_latency': 10.0,
}  # fmt: skip
"""Diagnostics come often, and a busy machine does not look like a fault."""


def given(values):
    """Words that give parameters these values, and those of `PATIENT` that are not among them."""
    values = {**PATIENT, **values}
    return [word for k, v in values.items() for word in ('-p', f'{k}:={str(v).lower()}')]


class Process:
    """The node in a second process, as a user starts it."""

    def __init__(self, *words, folder, start=ENTRY_POINT, command=None, **environment):
        self._log = folder / f'node_{time.monotonic_ns()}.log'
        with self._log.open('wb') as log:
            self.popen = subprocess.Popen(
                command or [sys.executable, *start, *words],
                env={**os.environ, **environment},
                stdout=subprocess.DEVNULL, stderr=log,
            )  # fmt: skip

    @property
    def log(self):
        """What it wrote to stderr so far."""
        return self._log.read_text()

    def wait_until_ready(self, text='listening to'):
        wait_for(lambda: text in self.log or self.popen.poll() is not None, f'{text!r} in the log')
        assert self.popen.poll() is None, self.log

    def wait_until_settled(self):
        """Wait until it has the backend that it keeps: labels may differ by one or two."""
        self.wait_until_ready()
        if FOLLOWS in self.log:
            self.wait_until_ready(CHANGED)

    def time_of(self, condition, what):
        """Time that the process runs or sleeps until `condition` holds, not that it is held up."""
        before, n_asleep = cpu_seconds(self.popen.pid), 0

        def holds():
            nonlocal n_asleep
            n_asleep += stat_words(self.popen.pid)[0] == 'S'
            return condition()

        wait_for(holds, what)
        return cpu_seconds(self.popen.pid) - before + n_asleep * LOOK_PERIOD

    def stop(self, number):
        """Send a signal; return the exit code."""
        self.popen.send_signal(number)
        return self.popen.wait(PATIENCE)

    def end_well(self, number=signal.SIGINT):
        """Send a signal, at which a node ends soon, with the cloud at hand, and says nothing."""
        self.popen.send_signal(number)
        seconds = self.time_of(lambda: stat_words(self.popen.pid)[0] == 'Z', 'end')
        assert self.popen.wait() == 0 and seconds < SOON, self.log
        assert 'Traceback' not in self.log and 'ERROR' not in self.log

    def __enter__(self):
        return self

    def __exit__(self, *_error):
        self.popen.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.popen.wait(10.0)
        self.popen.kill()  # does nothing to a process that has ended
        self.popen.wait()


@contextlib.contextmanager
def stderr_in(folder):
    """A function that returns what this process writes to stderr meanwhile, once it has all texts.

    A look at what capfd has empties it, and loses the line that a thread writes just then.
    """
    path, kept = folder / 'stderr', os.dup(2)

    def said(*texts):
        wait_for(lambda: all(text in path.read_text() for text in texts), f'{texts} on stderr')
        return path.read_text()

    try:
        with path.open('a') as file:
            os.dup2(file.fileno(), 2)
        yield said
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        sys.stderr.write(path.read_text())


def values_of(status):
    """The numbers of a status."""
    return {entry.key: entry.value for entry in status.values}


def parameter_messages(values):
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]


class Link:
    """What this process sends to a node of our namespace, and gets back from it.

    Publishes on ``points``, unless `sends` is None: then another program does.
    """

    node_name = f'{NAMESPACE}/{NODE_NAME}'

    def __init__(self, context, sends=RELIABLE):
        self.probe = Node('probe', context=context, namespace=NAMESPACE)
        self.publisher = sends and self.probe.create_publisher(PointCloud2, 'points', sends)
        self.ground = Collector(self.probe, PointCloud2, 'ground')
        self.obstacles = Collector(self.probe, PointCloud2, 'obstacles')
        self.diagnostics = Collector(self.probe, DiagnosticArray, '/diagnostics')
        self._clients = {}

    def wait_until_connected(self):
        if self.publisher:
            wait_for(lambda: self.publisher.get_subscription_count() == 1, 'subscription')
        for collector in (self.ground, self.obstacles, self.diagnostics):
            s = collector.subscription
            wait_for(lambda s=s: s.get_publisher_count() == 1, f'publisher of {s.topic_name}')

    def segment(self, *messages):
        """Publish clouds; return the outputs of the last one."""
        count = len(self.ground.messages) + len(messages)
        for message in messages:
            self.publisher.publish(message)
        return self.ground.wait(count)[-1], self.obstacles.wait(count)[-1]

    def publish_until(self, message, condition, what):
        """Publish a cloud over and over until `condition` holds."""
        wait_for(lambda: self.publisher.publish(message) or condition(), what)

    def set(self, name, value):
        """Reason for which ``ros2 param set`` is refused; empty if it is not."""
        (result,) = self.load({name: value})
        assert result.successful != bool(result.reason)
        return result.reason

    def load(self, values):
        """Results of setting all values at once, in their order, as ``ros2 param load`` does."""
        return self.request(SetParameters, parameter_messages(values))

    def request(self, setter, parameters):
        """Results of a service of `SETTERS` for messages of parameters."""
        response = self.call(setter, SETTERS[setter], setter.Request(parameters=parameters))
        return response.results if setter is SetParameters else [response.result]

    def call(self, service_type, name, request):
        """Response of a service of the node."""
        name = f'{self.node_name}/{name}'
        if name not in self._clients:
            self._clients[name] = self.probe.create_client(service_type, name)
            wait_for(self._clients[name].service_is_ready, f'service {name}')
        future = self._clients[name].call_async(request)
        wait_for(future.done, f'answer of {name}')
        return future.result()

    def forget(self, collector):
        """End what `collector` listens to."""
        self.in_executor(self.probe.destroy_subscription, collector.subscription)

    def in_executor(self, function, *arguments):
        """Result of a call made between two waits, where entities may safely go."""
        task = self.probe.executor.create_task(function, *arguments)
        wait_for(task.done, 'turn of the executor')
        return task.result()

    def wait_for_status(self, task, is_wanted):
        """Return the first status of the node's `task`, from now on, that is wanted.

        `is_wanted` is called with its numbers and the status itself.
        """
        start, name = len(self.diagnostics.messages), f'{self.node_name[1:]}: {task}'

        def found():
            statuses = (s for array in self.diagnostics.messages[start:] for s in array.status)
            return [s for s in statuses if s.name == name and is_wanted(values_of(s), s)]

        wait_for(found, f'wanted status of {name}')
        return found()[0]


class Bench(Link):
    """The node under test in this process, beside the probe that talks to it."""

    def __init__(self, context, values):
        cli_args = [*IN_NAMESPACE, *given(values)]
        self.node = GroundSegmentationNode(context=context, cli_args=cli_args)
        super().__init__(context)

    def wait_until_settled(self):
        """As that of a `Process`."""
        has_to_load = choose_backend(self.node.config.runtime.backend) == 'numba'
        wait_for(lambda: self.node._is_compiled or not has_to_load, 'compiled backend')

    def listen(self, topic, message_type=PointCloud2):
        """A `Collector` of an optional output, once the node knows of it and of no other."""
        optional = [p for o, p in self.node._outputs._publishers if o.is_optional]

        def wait_until_heard(n):
            wait_for(lambda: sum(p.get_subscription_count() for p in optional) == n, f'{n} ears')

        wait_until_heard(0)
        collector = Collector(self.probe, message_type, topic.replace('~', NODE_NAME))
        wait_until_heard(1)
        return collector

    @contextlib.contextmanager
    def changed(self, values):
        """Other values of parameters within the block."""
        before = {name: self.node.config[name] for name in values}
        assert all(result.successful for result in self.load(values))
        yield
        self.load(before)


@contextlib.contextmanager
def bench(values=None, settled=True):
    """A connected `Bench`, the node with these values of parameters."""
    with isolated_context() as context:
        b = Bench(context, values or {})
        with spinning(context, b.node, b.probe):
            b.wait_until_connected()
            if settled:
                b.wait_until_settled()
            yield b


@contextlib.contextmanager
def linked(sends=RELIABLE, connected=True):
    """A `Link` to a node of another process, connected unless that does not listen yet."""
    with isolated_context() as context:
        link = Link(context, sends)
        with spinning(context, link.probe):
            if connected:
                link.wait_until_connected()
            yield link


@contextlib.contextmanager
def linked_process(folder, values, connected=True, **options):
    """A `Process` in our namespace, and a `Link` to it."""
    with Process(*IN_NAMESPACE, *given(values), folder=folder, **options) as node:
        node.wait_until_ready()
        with linked(connected=connected) as link:
            yield node, link


@contextlib.contextmanager
def started_node(*words):
    """The node alone in this process, started with ``--ros-args words``."""
    with isolated_context() as context:
        node = GroundSegmentationNode(context=context, cli_args=['--ros-args', *words])
        with spinning(context, node):
            yield node
