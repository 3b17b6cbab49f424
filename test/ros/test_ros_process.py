"""The node, drivers and players, each a process: what comes back, what diagnostics say."""

import signal
import time
from pathlib import Path

import pytest
import ros_helpers as ros
from conftest import REPOSITORY
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterType
from ros_helpers import BEST_EFFORT, NAMESPACE, RELIABLE, street, to_message, wait_for
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan, PointCloud2

from gp_ground_seg.ros.input import NO_TIME

pytestmark = pytest.mark.usefixtures('compiled_code')

DEEP = {f'qos_overrides.{NAMESPACE}/points.subscription.depth': 5}
SMALL = to_message(street(500))
MIDDLE = to_message(street(6000))
"""A cloud of 0.4 MB, which stock Fast DDS loses from no publisher."""
LARGE = to_message(street(30_000))
"""A cloud of 1.9 MB."""


@pytest.fixture(scope='module')
def node(tmp_path_factory):
    """A node in a process of its own, started before any publisher."""
    words = *ros.IN_NAMESPACE, *ros.given(DEEP)
    with ros.Process(*words, folder=tmp_path_factory.mktemp('node')) as process:
        process.wait_until_settled()
        yield process
        assert process.stop(signal.SIGINT) == 0
        assert 'Traceback' not in process.log
        # Of drivers and clocks that the tests have sent, each once.
        warnings = [line for line in process.log.splitlines() if 'WARN' in line]
        wanted = 'come best-effort', 'is sent there', 'stamps are of another clock', NO_TIME
        counts = [sum(text in line for line in warnings) for text in wanted]
        assert max(counts) <= 1 and sum(counts) == len(warnings)


@pytest.fixture
def link(node):
    with ros.linked(sends=None) as link:
        # The node may still have clouds of the test before.
        while counts(link) != counts(link):
            pass
        for collector in (link.ground, link.obstacles):
            collector.messages.clear()
        yield link


@pytest.fixture
def sender(link):
    """A link that sends reliably."""
    link.publisher = add_publisher(link, RELIABLE)
    return link


def test_clouds_of_two_megabytes_at_10_hz_all_come_back(sender):
    message, next_time = to_message(street(30_000)), time.monotonic()
    for k in range(20):
        message.header.stamp.sec = k
        sender.publisher.publish(message)
        next_time += 0.1
        time.sleep(max(0.0, next_time - time.monotonic()))
        # Slower only where the machine is too busy for 10 Hz: more than the queue of
        # the node can hold would rightly be dropped.
        sender.ground.wait(k - 3)
    for parts in (sender.ground.wait(20), sender.obstacles.wait(20)):
        assert [part.header.stamp.sec for part in parts] == list(range(20))


@pytest.mark.parametrize('setter', ros.SETTERS)
def test_values_of_every_type_are_answered(sender, setter):
    """Also of those that do not exist, at which rclpy raises, and its callers wait for ever."""
    (message,) = ros.parameter_messages({'grid.r_max': 50.0})
    for number in (*range(20), 100, 255):
        message.value.type = number
        (result,) = sender.request(setter, [message])
        assert result.successful == (number == ParameterType.PARAMETER_DOUBLE)
        wanted = 'must be a number in' if number < 10 else f': {number} is not a valid'
        assert result.successful or wanted in result.reason
    sender.segment(SMALL)


def test_a_clock_that_is_missing_or_wrong_does_not_end_the_node(node, sender):
    """Without a time it says so; at a negative one rclpy raises."""
    clock = Clock()
    assert not sender.set('use_sim_time', True)
    sender.segment(SMALL)
    status = sender.wait_for_status('input', lambda _, s: NO_TIME in s.message)
    assert status.level == DiagnosticStatus.WARN
    publisher = sender.probe.create_publisher(Clock, '/clock', 1)

    def has_time(_, status):
        publisher.publish(clock)  # the first may be lost: both sides must know each other
        return NO_TIME not in status.message

    clock.clock.sec = 5
    sender.wait_for_status('input', has_time)
    clock.clock.sec = -5
    wait_for(lambda: publisher.publish(clock) or 'negative' in node.log, 'message')
    sender.segment(SMALL)
    assert not sender.set('use_sim_time', False)


# Publishers: reliable, best-effort, both, changing; their losses are counted.


def add_publisher(link, qos, n_publishers=1):
    """Another publisher; returns once the node has a subscription of its reliability for it."""
    publisher = link.probe.create_publisher(PointCloud2, 'points', qos)
    wait_until_followed(link, qos.reliability.short_key, n_publishers)
    wait_for(lambda: publisher.get_subscription_count() == 1, 'subscription')
    return publisher


def wait_until_followed(link, reliability, n_publishers):
    wanted = f'{reliability}, keep_last 5, volatile'
    link.wait_for_status(
        'input', lambda v, _: (v['QoS'], v['Publishers']) == (wanted, str(n_publishers))
    )


def counts(link):
    """Clouds that the node has lost and processed since its start."""
    values = ros.values_of(link.wait_for_status('processing', lambda *_: True))
    return int(values['Dropped since startup']), int(values['Clouds since startup'])


def send_and_wait(link, message, *publishers):
    """Send five clouds from each publisher, one after the other; all of them must come back."""
    n_answers = len(link.ground.messages)
    n_lost = counts(link)[0]
    for _ in range(5):
        for publisher in publishers:
            publisher.publish(message)
            n_answers += 1
            link.ground.wait(n_answers)
    assert counts(link)[0] == n_lost
    assert len(link.ground.messages) == len(link.obstacles.messages) == n_answers


@pytest.mark.slow
def test_every_cloud_comes_however_the_publishers_change(link):
    reliable = add_publisher(link, RELIABLE)
    send_and_wait(link, LARGE, reliable)
    best_effort = add_publisher(link, BEST_EFFORT, 2)
    send_and_wait(link, MIDDLE, reliable, best_effort)
    link.in_executor(link.probe.destroy_publisher, reliable)
    wait_until_followed(link, 'best_effort', 1)
    send_and_wait(link, MIDDLE, best_effort)
    # A driver ends and a bag is played: its first clouds are not lost to a best-effort reader.
    link.in_executor(link.probe.destroy_publisher, best_effort)
    wait_until_followed(link, 'reliable', 0)
    send_and_wait(link, LARGE, add_publisher(link, RELIABLE))


def test_large_clouds_that_come_best_effort_are_a_warning(node, link):
    link.publisher = add_publisher(link, BEST_EFFORT)
    link.publish_until(LARGE, lambda: len(link.ground.messages) >= 2, 'answer')
    status = link.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.WARN)
    assert 'clouds of 1.9 MB come best-effort' in status.message
    assert 'FASTRTPS_DEFAULT_PROFILES_FILE' in status.message
    node.wait_until_ready(f'on {NAMESPACE}/points, clouds')


def test_messages_of_another_type_are_named(node, link):
    wanted = 'sensor_msgs/msg/LaserScan is sent there, and sensor_msgs/msg/PointCloud2 is wanted'
    assert not link.set('diagnostics.stale_after', 0.5)
    with ros.isolated_context() as context:  # in the other one the topic has another type
        driver = ros.Node('driver', context=context, namespace=NAMESPACE)
        driver.create_publisher(LaserScan, 'points', BEST_EFFORT)
        status = link.wait_for_status(
            'input', lambda _, s: s.level == DiagnosticStatus.STALE and wanted in s.message
        )
        assert f'no cloud on {NAMESPACE}/points for' in status.message
        # It follows the publishers of clouds only, and this one offers best effort.
        assert 'reliable, keep_last 5' in ros.values_of(status)['QoS']
        assert ros.values_of(status)['Publishers'] == '0'
        assert not link.set('diagnostics.stale_after', 600.0)
        # Clouds beside it still come.
        send_and_wait(link, SMALL, add_publisher(link, RELIABLE))
        status = link.wait_for_status('input', lambda _, s: wanted in s.message)
        assert status.level == DiagnosticStatus.WARN
        driver.destroy_node()
    link.wait_for_status('input', lambda _, s: wanted not in s.message)
    node.wait_until_ready(f'on {NAMESPACE}/points, {wanted}')


# Sends best-effort clouds of 1.9 MB until it is ended; its domain is that of the environment.
DRIVER = f"""
import os, sys, time
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
import rclpy
domain = os.environ['ROS_DOMAIN_ID']
from ros_helpers import BEST_EFFORT, PointCloud2, street, to_message
rclpy.init(domain_id=int(domain))
node = rclpy.create_node('driver', namespace={NAMESPACE!r})
publisher = node.create_publisher(PointCloud2, 'points', BEST_EFFORT)
message = to_message(street(30_000))
while True:
    publisher.publish(message)
    time.sleep(0.1)
"""


@pytest.mark.slow
def test_best_effort_driver_with_the_large_segment_profile(node, tmp_path):
    profile = str(REPOSITORY / 'config' / 'fastdds_large_clouds.xml')
    driver = {'start': ('-c', DRIVER), 'FASTRTPS_DEFAULT_PROFILES_FILE': profile}
    with ros.linked(sends=None) as link, ros.Process(folder=tmp_path, **driver) as process:
        link.ground.wait(5)
        assert process.popen.poll() is None
        # Fast DDS only warns about a profile that it cannot read, and goes on without.
        assert 'XML' not in process.log
    assert 'points (best_effort' in node.log
