"""Bags played to the node, each a process: what comes back, what the diagnostics say."""

import itertools
import signal

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')
pytest.importorskip('rosbags', reason='rosbags is not installed')

from bag_samples import START, write_ros2_bag
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from ros_helpers import (
    BEST_EFFORT,
    NAMESPACE,
    PLAY,
    RELIABLE,
    Collector,
    Process,
    isolated_context,
    parameter_message,
    spinning,
    street,
    to_message,
    values_of,
    wait_for,
    wait_for_status,
)
from sensor_msgs.msg import PointCloud2

NODE = f'{NAMESPACE}/ground_segmentation_node'
# A busy machine must not look like a fault; everything else may.
PATIENT = {
    'diagnostics.period': 0.2,
    'diagnostics.stale_after': 60.0,
    'diagnostics.max_latency': 10.0,
    'diagnostics.max_load': 100.0,
    'learning.mode': 'fixed',
}
TO_NODE = ('--quiet', '--ros-args', '-r', f'/points:={NAMESPACE}/points')


def words(**settings):
    result = ['--ros-args', '-r', f'__ns:={NAMESPACE}']
    for name, value in settings.items():
        result += ['-p', f'{name}:={str(value).lower()}']
    return result


class Listener:
    """Hears all that the node says."""

    def __init__(self, context, qos=RELIABLE):
        self.node = Node('probe', context=context, namespace=NAMESPACE)
        self.ground = Collector(self.node, PointCloud2, 'ground', qos)
        self.obstacles = Collector(self.node, PointCloud2, 'obstacles', qos)
        self.diagnostics = Collector(self.node, DiagnosticArray, '/diagnostics')

    def wait_until_connected(self):
        for collector in (self.ground, self.obstacles, self.diagnostics):
            wait_for(lambda c=collector: c.n_publishers == 1, f'publisher of {collector.topic}')

    def statuses(self):
        return [status for array in self.diagnostics.messages for status in array.status]


@pytest.mark.parametrize('use_sim_time', [False, True], ids=['system_time', 'sim_time'])
def test_a_bag_of_2011_shows_ok(tmp_path, use_sim_time):
    bag = tmp_path / 'drive.mcap'
    write_ros2_bag(bag, 25)
    assert START < 1_320_000_000 * 10**9
    clock = ('--clock',) if use_sim_time else ()
    settings = {**PATIENT, 'use_sim_time': use_sim_time}
    with Process(*words(**settings), folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_ready()
        listener = Listener(context)
        with spinning(context, listener.node):
            listener.wait_until_connected()
            arguments = (str(bag), '--rate', '1', *clock, *TO_NODE)
            with Process(*arguments, folder=tmp_path, start=PLAY) as player:
                status = wait_for_status(
                    listener.diagnostics, NODE, 'input',
                    lambda values, _: int(values['Events since startup']) >= 20,
                )  # fmt: skip
                age = float(values_of(status)['Age of last stamp (s)'])
                assert player.popen.wait(60.0) == 0, player.log
            listener.ground.wait(25)
            listener.obstacles.wait(25)
            status = wait_for_status(listener.diagnostics, NODE, 'processing', lambda *_: True)
            values = values_of(status)
            assert (values['Clouds since startup'], values['Dropped since startup']) == ('25', '0')
            stamps = [
                part.header.stamp.sec * 10**9 + part.header.stamp.nanosec
                for part in listener.ground.messages
            ]
        levels = {(s.name, s.level) for s in listener.statuses()}
    tasks = ('input', 'processing', 'model', 'output')
    assert levels == {(f'{NODE[1:]}: {task}', DiagnosticStatus.OK) for task in tasks}
    assert (abs(age) < 5.0) if use_sim_time else (age > 4e8)
    assert len(stamps) == len(listener.obstacles.messages) == 25
    assert all(later - earlier == 10**8 for earlier, later in itertools.pairwise(stamps))
    assert 'WARN' not in node.log


def test_a_bag_in_a_loop_resets_what_was_learned(tmp_path):
    bag = tmp_path / 'drive.mcap'
    write_ros2_bag(bag, 15)
    settings = {**PATIENT, 'use_sim_time': True, 'learning.mode': 'first_frame'}
    with Process(*words(**settings), folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_ready()
        listener = Listener(context)
        with spinning(context, listener.node):
            listener.wait_until_connected()
            arguments = (str(bag), '--loop', '--rate', '2', '--clock', *TO_NODE)
            with Process(*arguments, folder=tmp_path, start=PLAY) as player:
                wait_for_status(
                    listener.diagnostics, NODE, 'input',
                    lambda values, _: int(values['Time jumps since startup']) >= 2,
                )  # fmt: skip
                wait_for_status(
                    listener.diagnostics, NODE, 'model',
                    lambda values, _: int(values.get('Learned since startup', 0)) >= 3,
                )  # fmt: skip
                assert player.popen.poll() is None, player.log
        reports = [
            {status.name.rpartition(' ')[2]: status for status in array.status}
            for array in listener.diagnostics.messages
        ]
    for report in reports:
        assert report['model'].level == DiagnosticStatus.OK
        n_rounds = 1 + int(values_of(report['input'])['Time jumps since startup'])
        n_learned = int(values_of(report['model']).get('Learned since startup', 0))
        # Once in each round, on its first cloud, which may be still to come.
        assert n_learned in (n_rounds - 1, n_rounds)
    # Rounds of less than a second: not said each time.
    times = [
        float(line.split('[')[2].rstrip('] '))
        for line in node.log.splitlines()
        if 'time jumped back by 1.' in line
    ]
    assert times
    assert all(later - earlier > 4.9 for earlier, later in itertools.pairwise(times))


def test_a_storm_of_parameters_loses_no_cloud(tmp_path):
    bag = tmp_path / 'drive.mcap'
    write_ros2_bag(bag, 30)
    good = itertools.cycle(
        [
            ('label.ground_tolerance', 0.3),
            ('grid.n_segments', 90),
            ('runtime.n_threads', 1),
            ('label.ground_tolerance', 0.2),
            ('grid.n_segments', 180),
            ('runtime.n_threads', 2),
        ]
    )
    bad = itertools.cycle(
        [
            ('label.ground_tolerance', 99.0),
            ('grid.n_segments', 'many'),
            ('grid.r_max', 1.5),
            ('no.such_parameter', 1),
        ]
    )
    with Process(*words(**PATIENT), folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_ready()
        listener = Listener(context)
        client = listener.node.create_client(SetParameters, f'{NODE}/set_parameters')
        with spinning(context, listener.node):
            listener.wait_until_connected()
            wait_for(client.service_is_ready, 'service')
            arguments = (str(bag), '--rate', '0.6', *TO_NODE)
            with Process(*arguments, folder=tmp_path, start=PLAY) as player:
                listener.ground.wait(3)
                n_before = len(listener.ground.messages)
                n_during = []
                for k in range(100):
                    name, value = next(bad if k % 5 == 4 else good)
                    request = SetParameters.Request(parameters=[parameter_message(name, value)])
                    future = client.call_async(request)
                    wait_for(future.done, f'answer to change {k}')
                    (result,) = future.result().results
                    assert result.successful == (k % 5 != 4), result.reason
                    assert result.successful or name in result.reason
                    n_during.append(len(listener.ground.messages))
                # They came while clouds did; on a busy machine the last ones come later.
                assert n_before < n_during[-1]
                assert n_during[20] < 30
                assert player.popen.wait(60.0) == 0, player.log
            listener.ground.wait(30)
            listener.obstacles.wait(30)
            status = wait_for_status(
                listener.diagnostics, NODE, 'processing',
                lambda values, _: values['Clouds since startup'] == '30',
            )  # fmt: skip
        assert values_of(status)['Dropped since startup'] == '0'
        assert len(listener.ground.messages) == len(listener.obstacles.messages) == 30
        assert node.stop(signal.SIGINT)[0] == 0
        assert 'Traceback' not in node.log


def test_quality_of_service_both_ways(tmp_path):
    """Every kind of publisher is heard, every kind of subscriber served, by one node."""
    message = to_message(street(500))
    with Process(*words(**PATIENT), folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_ready()
        for given, taken in itertools.product((RELIABLE, BEST_EFFORT), repeat=2):
            listener = Listener(context, taken)
            publisher = listener.node.create_publisher(PointCloud2, 'points', given)
            with spinning(context, listener.node):
                listener.wait_until_connected()

                def both_came(listener=listener, publisher=publisher):
                    publisher.publish(message)
                    return listener.ground.messages and listener.obstacles.messages

                wait_for(both_came, f'clouds from {given} to {taken}')


def test_a_bad_cloud_among_good_ones(tmp_path):
    good, bad = to_message(street(500), frame='lidar'), to_message(street(500), frame='broken')
    bad.fields[3].name = 'altitude'
    settings = {**PATIENT, 'diagnostics.recover_after': 0.5}
    with Process(*words(**settings), folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_ready()
        listener = Listener(context)
        publisher = listener.node.create_publisher(PointCloud2, 'points', RELIABLE)
        with spinning(context, listener.node):
            listener.wait_until_connected()
            wait_for(lambda: publisher.get_subscription_count() == 1, 'subscription')
            for k in range(1, 4):
                publisher.publish(good)
                listener.ground.wait(2 * k - 1)
                publisher.publish(bad)
                publisher.publish(good)
                listener.ground.wait(2 * k)
            status = wait_for_status(
                listener.diagnostics, NODE, 'input',
                # Of the last of them: a good one in the same report would not take it back.
                lambda values, status: status.level == DiagnosticStatus.ERROR
                and values['Events since startup'] == '9',
            )  # fmt: skip
            assert 'no field named z' in status.message
            publisher.publish(good)
            status = wait_for_status(
                listener.diagnostics, NODE, 'input',
                lambda values, status: status.level == DiagnosticStatus.OK
                and values['Events since startup'] == '10',
            )  # fmt: skip
            assert values_of(status)['Refused since startup'] == '3'
        # Throttled: three bad clouds, one message with topic, frame and reason.
        (line,) = [line for line in node.log.splitlines() if 'ERROR' in line]
        assert f"cloud on {NAMESPACE}/points in frame 'broken' refused: " in line
        assert 'no field named z' in line
        assert node.stop(signal.SIGINT)[0] == 0
