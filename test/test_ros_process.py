"""The node, drivers and players, each a process: what comes back, what diagnostics say."""

import itertools
import signal
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')
pytest.importorskip('rosbags', reason='rosbags is not installed')

import ros_helpers as ros
from bag_samples import write_ros2_bag
from conftest import REPOSITORY
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterType
from ros_helpers import NAMESPACE, street, to_message
from rosgraph_msgs.msg import Clock

# A busy machine must not look like a fault; everything else may.
PATIENT = {
    'diagnostics.period': 0.2,
    'diagnostics.stale_after': 60.0,
    'diagnostics.max_latency': 10.0,
    'diagnostics.max_load': 100.0,
}
# Nor be one: a node that cannot run for four seconds at 10 Hz loses nothing.
WORDS = ros.given({**PATIENT, f'qos_overrides.{NAMESPACE}/points.subscription.depth': 40})


def play(bag, *words):
    to_node = ('--quiet', '--ros-args', '-r', f'/points:={NAMESPACE}/points')
    return ros.Process(str(bag), *words, *to_node, folder=bag.parent, start=ros.PLAY)


def assert_throttled(lines):
    """That a message came, and not again within five seconds, however busy the machine."""
    times = [float(line.split('[')[2].rstrip('] ')) for line in lines]
    assert times
    assert all(later - earlier > 4.9 for earlier, later in itertools.pairwise(times))


@pytest.mark.slow
def test_a_bag_in_a_loop_with_a_clock_resets_what_was_learned(tmp_path):
    bag = tmp_path / 'drive.mcap'
    write_ros2_bag(bag, 15)
    changes = ros.given({'use_sim_time': True, 'learning.mode': 'first_frame'})
    with ros.linked_process(tmp_path, *WORDS, *changes, sends=None) as (node, link):
        with play(bag, '--loop', '--rate', '1', '--clock') as player:
            link.wait_for_status('input', lambda v, _: int(v['Time jumps since startup']) >= 2)
            link.wait_for_status('model', lambda v, _: int(v.get('Learned since startup', 0)) >= 3)
            assert player.popen.poll() is None, player.log
        reports = [
            {status.name.rpartition(' ')[2]: status for status in array.status}
            for array in link.diagnostics.messages
        ]
    ages = []
    for report in reports:
        said = {name: (s.level, s.message) for name, s in report.items()}
        assert {level for level, _ in said.values()} == {DiagnosticStatus.OK}, said
        values = ros.values_of(report['input'])
        ages.append(values['Age of last stamp (s)'])
        n_rounds = 1 + int(values['Time jumps since startup'])
        n_learned = int(ros.values_of(report['model']).get('Learned since startup', 0))
        # Once in each round, on its first cloud, which may be still to come.
        assert n_learned in (n_rounds - 1, n_rounds)
    # On the simulated clock clouds of 2011 are new.
    known = [float(age) for age in ages if age != 'unknown']
    assert known
    assert max(map(abs, known)) < 5.0
    # Not said in each round, of a second and a half.
    jumps = [line for line in node.log.splitlines() if 'time jumped back by ' in line]
    assert_throttled(jumps)
    # A round is 1.4 s, less what comes late at its ends; below 0.5 s is no jump.
    assert all(0.5 <= float(line.split(' back by ')[1].split()[0]) < 2.0 for line in jumps)
    assert 'WARN' not in node.log


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
        assert all('come best-effort' in line for line in warnings)


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
    assert 'subscribing best_effort' in node.log


@pytest.mark.usefixtures('node')
@pytest.mark.parametrize('sends', ['RELIABLE', 'BEST_EFFORT'])
def test_a_best_effort_subscriber_is_served(sends):
    with ros.linked(getattr(ros, sends), ros.BEST_EFFORT) as link:
        link.publish_until(
            to_message(street(500)),
            lambda: link.ground.messages and link.obstacles.messages,
            'clouds',
        )
