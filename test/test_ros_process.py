"""The node, drivers and players, each a process: what comes back, what diagnostics say."""

import signal
import sys
import time
from pathlib import Path

import pytest
import ros_helpers as ros
from conftest import REPOSITORY
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterType
from ros_helpers import NAMESPACE, street, to_message
from rosgraph_msgs.msg import Clock

from gp_ground_seg.ros.input import NO_TIME

# A busy machine must not look like a fault; everything else may.
PATIENT = {
    'diagnostics.period': 0.2,
    'diagnostics.stale_after': 60.0,
    'diagnostics.max_latency': 10.0,
}
# Nor be one: a node that cannot run for four seconds at 10 Hz loses nothing.
WORDS = ros.given({**PATIENT, f'qos_overrides.{NAMESPACE}/points.subscription.depth': 40})


@pytest.fixture(scope='module')
def node(tmp_path_factory):
    folder = tmp_path_factory.mktemp('node')
    with ros.Process(*ros.IN_NAMESPACE, *WORDS, folder=folder) as process:
        process.wait_until_settled()
        yield process
        assert process.stop(signal.SIGINT)[0] == 0
        assert 'Traceback' not in process.log
        # Large clouds of a best-effort driver are warned of.
        warnings = [line for line in process.log.splitlines() if 'WARN' in line]
        assert all('come best-effort' in line or NO_TIME in line for line in warnings)


@pytest.mark.usefixtures('node')
def test_clouds_of_two_megabytes_at_10_hz_all_come_back():
    message = to_message(street(30_000, n_invalid=100), frame='velo_link')
    assert len(message.data) == 1_920_000
    with ros.linked() as link:
        next_time = time.monotonic()
        for k in range(20):
            message.header.stamp.sec = k
            link.publisher.publish(message)
            next_time += 0.1
            time.sleep(max(0.0, next_time - time.monotonic()))
            # Slower only where the machine is too busy for 10 Hz: more than the queue of
            # the node can hold would rightly be dropped.
            link.ground.wait(k - 3)
        for parts in (link.ground.wait(20), link.obstacles.wait(20)):
            assert [part.header.stamp.sec for part in parts] == list(range(20))


@pytest.mark.usefixtures('node')
@pytest.mark.parametrize('setter', ros.SETTERS)
def test_values_of_every_type_are_answered(setter):
    """Also of those that do not exist, at which rclpy raises, and its callers wait for ever."""
    with ros.linked() as link:
        (message,) = ros.parameter_messages({'grid.r_max': 50.0})
        for number in range(256):
            message.value.type = number
            (result,) = link.request(setter, [message])
            assert result.successful == (number == ParameterType.PARAMETER_DOUBLE)
            wanted = 'must be a number in' if number < 10 else f': {number} is not a valid'
            assert result.successful or wanted in result.reason
        link.segment(to_message(street(500)))


def test_what_rclpy_raises_does_not_end_the_node(node):
    """A negative time on /clock, for example."""
    with ros.linked() as link:
        assert link.set('use_sim_time', True).successful
        publisher, clock = link.probe.create_publisher(Clock, '/clock', 1), Clock()
        clock.clock.sec = -5
        ros.wait_for(lambda: publisher.publish(clock) or 'negative' in node.log, 'message')
        link.segment(to_message(street(500)))
        assert link.set('use_sim_time', False).successful


def test_simulated_time_without_a_clock_is_said(node):
    with ros.linked() as link:
        assert link.set('use_sim_time', True).successful
        link.segment(to_message(street(500)))
        status = link.wait_for_status('input', lambda _, s: NO_TIME in s.message)
        assert status.level == DiagnosticStatus.WARN
        link.diagnostics.wait(8)
        (line,) = [line for line in node.log.splitlines() if NO_TIME in line]
        assert '[WARN]' in line
        publisher, clock = link.probe.create_publisher(Clock, '/clock', 1), Clock()
        clock.clock.sec = 5
        ros.wait_for(lambda: publisher.get_subscription_count() == 1, 'subscription of /clock')

        def has_time(_, status):
            publisher.publish(clock)  # the first may be lost: both sides must know each other
            return NO_TIME not in status.message

        link.wait_for_status('input', has_time)
        assert link.set('use_sim_time', False).successful


# Sends best-effort clouds of 1.9 MB until it is ended; its domain is that of the environment.
DRIVER = f"""
import sys, time
sys.path.insert(0, {str(Path(__file__).parent)!r})
import rclpy
from ros_helpers import BEST_EFFORT, PointCloud2, street, to_message
rclpy.init()
node = rclpy.create_node('driver', namespace=sys.argv[1])
publisher = node.create_publisher(PointCloud2, 'points', BEST_EFFORT)
message = to_message(street(30_000))
while True:
    publisher.publish(message)
    time.sleep(0.1)
"""


@pytest.mark.slow
def test_best_effort_driver_with_the_large_segment_profile(node, tmp_path):
    profile = REPOSITORY / 'config' / 'fastdds_large_clouds.xml'
    environment = {'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile)}
    command = [sys.executable, '-c', DRIVER, NAMESPACE]
    with (
        ros.linked(sends=None) as link,
        ros.Process(folder=tmp_path, command=command, **environment) as driver,
    ):
        link.ground.wait(5)
        assert driver.popen.poll() is None
        # Fast DDS only warns about a profile that it cannot read, and goes on without.
        assert 'XML' not in driver.log
    assert 'points (best_effort' in node.log


@pytest.mark.usefixtures('node')
def test_a_best_effort_subscriber_is_served():
    with ros.linked(ros.BEST_EFFORT, ros.BEST_EFFORT) as link:
        answers = link.ground.messages, link.obstacles.messages
        link.publish_until(to_message(street(500)), lambda: all(answers), 'clouds')
