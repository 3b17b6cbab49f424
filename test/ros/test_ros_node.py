"""The node in this process: what goes in, what comes out, what it says of itself."""

import dataclasses
import re
import time

import numpy as np
import pytest
import ros_helpers as ros
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock_type import ClockType
from rclpy.logging import LoggingSeverity
from rclpy.time import Time
from ros_helpers import NAMESPACE, bench, street, to_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.core.pipeline.sensor_pose import LITTLE_GROUND, NO_HEIGHT
from gp_ground_seg.lab.simulation import HDL_64E, SCENES, simulate_scan
from gp_ground_seg.ros import diagnostics

pytestmark = pytest.mark.usefixtures('compiled_code')

OVERRIDES = f'qos_overrides.{NAMESPACE}/points.subscription'


@pytest.mark.parametrize('reliability', ['reliable', 'best_effort'])
def test_reliability_asked_for_is_kept(reliability):
    message = to_message(street(1000))
    with bench({f'{OVERRIDES}.reliability': reliability, f'{OVERRIDES}.depth': 9}) as b:
        b.segment(message)
        b.publisher = b.probe.create_publisher(PointCloud2, 'points', ros.BEST_EFFORT)
        b.wait_for_status('input', lambda v, _: v['Publishers'] == '2')
        # A reliable reader gets nothing from the second publisher, and says so.
        said = 'qos_overrides asks for reliable, and a publisher offers best effort'
        if reliability == 'reliable':
            b.wait_for_status('input', lambda _, s: said in s.message)
        else:
            b.publish_until(message, lambda: len(b.ground.messages) > 1, 'answer')
        assert b.node._input.qos_words == f'{reliability}, keep_last 9, volatile'


def test_a_lazy_node_listens_only_while_somebody_listens_to_it():
    message = to_message(street(1000))
    with bench({'input.lazy': True, 'diagnostics.stale_after': 0.5}) as b:

        def wait_until_listening(n):
            ros.wait_for(lambda: b.publisher.get_subscription_count() == n, f'{n} subscriptions')

        b.segment(message)
        for collector in (b.ground, b.obstacles):
            b.forget(collector)
        wait_until_listening(0)
        status = b.wait_for_status(
            'input', lambda v, s: s.level == DiagnosticStatus.OK and v['Publishers'] == '1'
            and float(v['Time since last cloud (s)']) > 0.6
        )  # fmt: skip
        assert 'no output has a subscriber (input.lazy)' in status.message
        # What nobody wanted is not lost.
        for _ in range(5):
            b.publisher.publish(message)
        labelled = ros.Collector(b.probe, PointCloud2, f'{b.node_name}/labeled')
        wait_until_listening(1)
        b.publisher.publish(message)  # one: clouds every few milliseconds fill the queue
        labelled.wait(1)
        b.wait_for_status('processing', lambda v, _: v['Dropped since startup'] == '0')


def test_the_log_says_now_and_then_what_diagnostics_say(tmp_path, monkeypatch):
    monkeypatch.setattr(diagnostics, 'LOG_PERIOD', 0.5)
    with ros.stderr_in(tmp_path) as said, bench({'diagnostics.period': 0.2}) as b:
        b.segment(to_message(street(3000)))
        said('so far: 1 clouds segmented, 0 lost, 0 refused; input ', '; model OK: ')


def test_diagnostics_of_a_stream_of_2011_that_starts_again_twice(tmp_path):
    points = street(3000)
    with ros.stderr_in(tmp_path) as said, bench({'diagnostics.stale_after': 1.0}) as b:
        stale = b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.STALE)
        assert f'{NAMESPACE}/points' in stale.message
        assert not b.set('diagnostics.stale_after', 600.0)
        # 0.4 s back is no jump: several sensors may send.
        for second, nanosec in ((0, 0), (1, 4 * 10**8), (1, 0), (2, 0), (0, 0), (1, 0), (0, 0)):
            b.segment(to_message(points, (1317383000 + second, nanosec), 'velo_link'))
        b.wait_for_status('input', lambda _, s: 'use_sim_time for a recording' in s.message)
        statuses = [b.wait_for_status('input', lambda v, _: v['Events since startup'] == '7')]
        statuses += [b.wait_for_status(task, lambda v, _: v) for task in ('processing', 'model')]
        # Throttled: two jumps, one message; clouds of the first minute, one line.
        log = said('time jumped back by 2.0 s', 'first cloud: ')
        assert log.count('time jumped back') == log.count('first cloud: ') == 1
        assert 'so far' not in log

    for status, level in zip(
        statuses, (DiagnosticStatus.WARN, *2 * [DiagnosticStatus.OK]), strict=True
    ):
        assert (status.level, status.hardware_id) == (level, b.node_name)
    assert statuses[0].message.startswith('stamps are of another clock, 4')
    values = ros.values_of(statuses[0])
    assert float(values['Age of last stamp (s)']) > 1e8
    assert values['QoS'] == 'reliable, keep_last 1, volatile'
    assert values['Time jumps since startup'] == '2'


def test_ages_are_on_the_clock_of_the_node():
    with bench({'use_sim_time': True}) as b:
        publisher = b.probe.create_publisher(Clock, '/clock', ros.RELIABLE)
        ros.wait_for(lambda: publisher.get_subscription_count() == 1, 'subscription of /clock')
        now = Time(seconds=1317383000, clock_type=ClockType.ROS_TIME)
        publisher.publish(Clock(clock=now.to_msg()))
        ros.wait_for(lambda: b.node.get_clock().now() == now, 'time')
        b.segment(to_message(street(3000), stamp=(1317382999, 500000000)))
        status = b.wait_for_status('input', lambda v, _: v['Events since startup'] == '1')
        assert ros.values_of(status)['Age of last stamp (s)'] == '0.500'
        assert status.level == DiagnosticStatus.OK


def test_drops_are_counted_exactly():
    message = to_message(street(20_000))
    with bench({f'{OVERRIDES}.depth': 1}) as b:
        b.segment(message)  # the first cloud of a publisher opens its count
        for _ in range(29):
            b.publisher.publish(message)
        # What is lost at the end is known with the next cloud.
        for n_sent in range(31, 50):
            n_answers = len(b.ground.messages)
            b.publisher.publish(message)
            b.ground.wait(n_answers + 1)
            values = ros.values_of(b.wait_for_status('processing', lambda *_: True))
            n_dropped = int(values['Dropped since startup'])
            if int(values['Clouds since startup']) + n_dropped == n_sent:
                break
        assert n_sent == n_dropped + len(b.ground.messages)
        assert n_dropped > 0


# One node for all that follows: it would hear the clouds of others


@pytest.fixture(scope='module')
def b():
    # Clouds are sent faster than they are taken; nothing is compiled for numpy.
    with bench({f'{OVERRIDES}.depth': 5, 'runtime.backend': 'numpy'}) as shared:
        yield shared
        assert shared.node._loader is None


def turn_of_packets(width=10):
    """A cloud of a sensor 1.2 m up, and the parts of it in sectors [degrees], as points."""
    sensor = dataclasses.replace(HDL_64E, height=1.2, n_columns=600)
    made = simulate_scan(SCENES['urban'](0), sensor, np.random.default_rng(0)).points
    points = ros.moved(np.zeros(len(made), ros.POINT), made)
    points['intensity'] = np.arange(len(made))
    sector = np.degrees(np.arctan2(made[:, 1], made[:, 0])) % 360.0 // width
    return points, [points[sector == k] for k in range(360 // width)]


def test_packets_have_the_height_of_the_last_cloud_until_that_is_forgotten(b, tmp_path):
    """With another frame, other parameters, or when time jumps back: as at the start."""
    points, packets = turn_of_packets()
    packet, kept = max(packets, key=len), 'of an earlier one is kept'

    def ground_of(cloud, frame='spinning', second=100):
        """Numbers of the points of the ground, which are their intensity."""
        ground, _ = b.segment(to_message(cloud, (second, 0), frame))
        return {row[:4] for row in ros.rows_of(ground)}

    def after_the_whole(**where):
        ground_of(points)
        return ground_of(packet, **where)

    with ros.stderr_in(tmp_path) as said:
        at_start = ground_of(packet)
        b.wait_for_status('model', lambda _, s: s.message.startswith((LITTLE_GROUND, NO_HEIGHT)))
        whole = ground_of(points)
        b.wait_for_status('model', lambda _, s: s.level == DiagnosticStatus.OK)
        parts = set().union(*map(ground_of, packets))
        assert len(whole & parts) / len(whole | parts) >= 0.95
        status = b.wait_for_status('model', lambda _, s: kept in s.message)
        values = ros.values_of(status)
        height = float(values['Sensor height (m)'])
        assert height == pytest.approx(1.2, abs=0.05)
        assert f'the height of {height:.2f} m' in status.message
        assert (status.level, values['Taken from the scan']) == (DiagnosticStatus.WARN, 'nothing')
        # Once, not for each packet.
        assert said(kept).count(kept) == 1
    later = after_the_whole(second=101)
    assert later == ground_of(packet, second=101) != at_start
    assert after_the_whole(frame='other') == at_start
    # Back in the first frame nothing has been seen yet.
    assert ground_of(packet) == at_start
    assert after_the_whole(second=99) == at_start
    assert after_the_whole() == later
    for least in (0.01, -100.0):
        assert not b.set('output.min_height', least)
    assert ground_of(packet) == at_start
    # A cloud that shows the ground takes the place of the one before.
    for cloud in (points, ros.moved(points.copy(), ros.xyz_of(points) - [0, 0, 0.5]), packets[0]):
        ground_of(cloud)
    b.wait_for_status('model', lambda v, _: float(v['Sensor height (m)']) > height + 0.4)


def test_bad_clouds_among_good_ones_are_refused_with_one_message(b, tmp_path):
    with ros.stderr_in(tmp_path) as said:
        good = to_message(street(500), frame='lidar')
        bad = [to_message(street(500), frame='broken') for _ in range(3)]
        bad[0].fields[3].name = 'altitude'
        bad[1].data, bad[2].point_step = bad[1].data[:-1], 0
        n_answers = len(b.ground.messages)
        for cloud in bad:
            b.publisher.publish(cloud)
            b.segment(good)
        assert len(b.ground.messages) == n_answers + 3
        b.publisher.publish(bad[0])
        status = b.wait_for_status('input', lambda v, _: v['Refused since startup'] == '4')
        assert status.level == DiagnosticStatus.ERROR and 'no field named z' in status.message
        assert ros.values_of(status)['Frame'] == 'broken'
        b.segment(good)
        b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.WARN)  # of its stamps
        # Throttled: four clouds, one message with topic, frame and reason.
        log = said(f"cloud on {NAMESPACE}/points in frame 'broken' refused: ")
        assert log.count('refused') == log.count('no field named z') == 1


def test_errors_inside_the_library_do_not_end_the_node(b, monkeypatch):
    message = to_message(street(3000))
    with monkeypatch.context() as patch:
        patch.setattr(GroundSegmenter, 'segment', lambda *_: 1 / 0)
        b.publisher.publish(message)
        status = b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.ERROR)
        assert 'ZeroDivisionError' in status.message
    b.segment(message)


def test_times_of_the_stages_are_logged_at_level_debug(b, tmp_path):
    with ros.stderr_in(tmp_path) as said:
        b.node.get_logger().set_level(LoggingSeverity.DEBUG)
        b.segment(to_message(street(3000)))
        log = said('publish ')
        b.node.get_logger().set_level(LoggingSeverity.INFO)
    (times,) = re.findall(r'times of the stages \[ms\]: (.*)', log)
    names, numbers = zip(*(part.split() for part in times.split(', ')), strict=True)
    stages = 'queue frames grid pose faces lines learning surface label total publish'
    assert sorted(names) == sorted(stages.split())
    assert sum(map(float, numbers)) > 0.0


GAPS = [
    ((7, 8, 1, 2, 5, None, 200, None), 1, 2),  # another one counts from 1; none has numbers
    ((50, 1, 51, 2, 3, 54, 7, 8, 55), 2, 5),
    ((5, 5, 6, 8, 6, 7, 9), 2, 1),
    ((5, 900, 6, 1, 901, 2, 7, 4, 903), 3, 2),
]


@pytest.mark.parametrize(('numbers', 'n_publishers', 'n_lost'), GAPS)
def test_a_gap_in_the_numbers_of_a_publisher_is_a_loss(b, numbers, n_publishers, n_lost):
    source, task = b.node._input, b.node._diagnostics.processing
    before = task.n_dropped
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(source, '_offered', dict.fromkeys(range(n_publishers)))
        patch.setattr(source, '_look_at_publishers', lambda: False)
        patch.setattr(source, '_numbers', [])
        for number in numbers:
            info = {'publication_sequence_number': number}
            b.in_executor(source._receive, to_message(street(50)), info)
    assert task.n_dropped == before + n_lost


def test_the_wait_of_a_cloud_is_a_part_of_its_latency(b, monkeypatch):
    latencies = []
    task = b.node._diagnostics.processing
    monkeypatch.setattr(task, 'processed', lambda latency, *_: latencies.append(latency))
    received = {'received_timestamp': time.time_ns() - 100 * 10**9}
    b.in_executor(b.node._input._receive, to_message(street(500)), received)
    ros.wait_for(lambda: latencies, 'latency')
    assert 100.0 < latencies[0] < 130.0


@pytest.mark.parametrize(
    ('off', 'said'),
    [(0.9, ''), (3600.0, '3600.0 s before'), (-3600.0, '3600.0 s after'), (None, ' s before')],
)
def test_stamps_of_another_clock_are_a_warning(b, off, said):
    """An hour off either way, or all the same; the wait in a queue of ours does not count."""
    send_time = time.time_ns() - 10 * 10**9
    for k in range(10):
        sent = send_time + k * 10**9
        seconds, rest = divmod(sent - round(1e9 * (off or 0.0)), 10**9)
        stamp = (seconds, rest) if off is not None else (send_time // 10**9, 0)
        info = {'source_timestamp': sent}
        b.in_executor(b.node._input._receive, to_message(street(50), stamp), info)
    status = b.wait_for_status('input', lambda *_: True)
    level = DiagnosticStatus.WARN if said else DiagnosticStatus.OK
    assert status.level == level and said in status.message
    assert ('timestamp mode of the driver' in status.message) == bool(said)


def test_what_the_library_says_of_a_cloud_its_node_says(b, tmp_path):
    """Not the other nodes of the process."""
    words = '--ros-args', *ros.given({'runtime.backend': 'numpy'})
    silent = ros.GroundSegmentationNode(
        context=b.node.context, namespace='/silent', cli_args=words
    )
    with ros.stderr_in(tmp_path) as said:
        assert not b.set('sensor.height', 5.0)
        b.segment(to_message(street(3000)))
        log = said('is sensor.height right')
        silent.destroy_node()
        assert not b.set('sensor.height', 'auto')
    assert log.count('is sensor.height right') == 1
