"""The node in this process: what goes in, what comes out."""

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock_type import ClockType
from rclpy.time import Time
from ros_helpers import (
    BEST_EFFORT,
    NAMESPACE,
    POINT,
    RELIABLE,
    Bench,
    Collector,
    bench,
    isolated_context,
    rows_of,
    spinning,
    street,
    to_message,
    wait_for,
    xyz_of,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.ros.node import GroundSegmentationNode

OFTEN = ('-p', 'diagnostics.period:=0.1', '-p', 'diagnostics.recover_after:=0.3')


def assert_partition(message, points, ground, obstacles):
    """Every finite point, bit for bit and in order, in the cloud of its label."""
    label = GroundSegmenter().segment(xyz_of(points)).label
    rows = rows_of(to_message(points))
    for part, wanted in ((ground, Label.GROUND), (obstacles, Label.OBSTACLE)):
        kept = [row for row, found in zip(rows, label, strict=True) if found == wanted]
        assert rows_of(part) == kept
        assert part.header == message.header
        assert part.fields == message.fields
        assert (part.height, part.width) == (1, len(kept))
        assert part.point_step == message.point_step
        assert part.row_step == len(kept) * message.point_step
        assert not part.is_bigendian
        assert part.is_dense
    assert ground.width + obstacles.width == np.isfinite(xyz_of(points)).all(axis=1).sum()


def test_every_finite_point_is_in_exactly_one_cloud_bit_for_bit():
    points = street(20_000, n_invalid=200)
    message = to_message(points, stamp=(1317383, 123456789), frame='velo_link')
    with bench() as b:
        ground, obstacles = b.segment(message)
        assert min(ground.width, obstacles.width) > 1000
        assert_partition(message, points, ground, obstacles)


def test_odd_layouts():
    points = street(6000)
    with bench() as b:
        message = to_message(points)
        # Organised, rows padded with bytes that must not show up.
        message.height, message.width = 60, 100
        message.row_step = 100 * POINT.itemsize + 7
        rows = bytes(message.data)
        row_bytes = 100 * POINT.itemsize
        message.data = b''.join(
            rows[start : start + row_bytes] + b'padding'
            for start in range(0, len(rows), row_bytes)
        )
        ground, obstacles = b.segment(message)
        assert_partition(message, points, ground, obstacles)

        # Big-endian doubles, z first.
        swapped = np.zeros(6000, np.dtype([('z', '>f8'), ('y', '>f8'), ('x', '>f8')]))
        for axis in 'xyz':
            swapped[axis] = points[axis]
        message = to_message(swapped)
        message.is_bigendian = True
        ground, obstacles = b.segment(message)
        label = GroundSegmenter().segment(xyz_of(points)).label
        assert bytes(ground.data) == swapped[label == Label.GROUND].tobytes()
        assert bytes(obstacles.data) == swapped[label == Label.OBSTACLE].tobytes()
        assert ground.is_bigendian
        assert obstacles.is_bigendian


def test_clouds_with_nothing_in_them_give_two_empty_clouds():
    with bench() as b:
        invalid = street(50, n_invalid=50)
        for points in (street(0), invalid):
            message = to_message(points, stamp=(5, 6), frame='lidar')
            for part in b.segment(message):
                assert (part.height, part.width, len(part.data)) == (1, 0, 0)
                assert part.header == message.header
                assert part.fields == message.fields


def test_bad_cloud_is_refused_and_the_next_one_processed():
    points = street(3000)
    bad = to_message(points, frame='bad_frame')
    bad.fields[3].name = 'height'
    with bench(*OFTEN) as b:
        b.publisher.publish(bad)
        status = b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.ERROR)
        assert 'no field named z' in status.message
        values = {entry.key: entry.value for entry in status.values}
        assert values['Frame'] == 'bad_frame'
        assert values['Refused since startup'] == '1'

        message = to_message(points)
        assert_partition(message, points, *b.segment(message))
        assert len(b.ground.messages) == 1
        b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.OK)


def test_error_inside_the_library_does_not_end_the_node(monkeypatch):
    message = to_message(street(3000))
    with bench(*OFTEN) as b:
        with monkeypatch.context() as patch:
            patch.setattr(GroundSegmenter, 'segment', lambda *_: 1 / 0)
            b.publisher.publish(message)
            status = b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.ERROR)
            assert 'ZeroDivisionError' in status.message
        b.segment(message)


def test_diagnostics_of_a_stream():
    message = to_message(street(3000), stamp=(1317383000, 0), frame='velo_link')
    limits = '-p', 'diagnostics.stale_after:=3.0', '-p', 'diagnostics.max_latency:=10.0'
    with bench(*OFTEN, *limits) as b:
        stale = b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.STALE)
        assert f'{NAMESPACE}/points' in stale.message
        for _ in range(3):
            b.segment(message)
        status = b.wait_for_status('processing', lambda v, _: v['Clouds since startup'] == '3')
        assert status.level == DiagnosticStatus.OK
        values = {entry.key: entry.value for entry in status.values}
        assert 0.0 < float(values['Latency p50 (ms)']) <= float(values['Latency p99 (ms)'])
        assert values['Dropped since startup'] == '0'
        assert values['Backend'] in ('numba', 'numpy')
        assert int(values['Threads']) >= 1

        b.segment(message)
        # A stamp of 2011 is old, and nothing is wrong with that.
        status = b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.OK)
        values = {entry.key: entry.value for entry in status.values}
        assert float(values['Age of last stamp (s)']) > 1e8
        assert values['Fields'] == ' '.join(POINT.names)
        assert values['QoS'] == 'reliable, keep_last 5, volatile'
        assert values['Publishers'] == '1'
        assert values['Clock'] == 'system time'
        status = b.wait_for_status('model', lambda v, _: 'frame_quality' in v)
        assert status.level == DiagnosticStatus.OK
        values = {entry.key: entry.value for entry in status.values}
        assert 0.2 < float(values['frame_quality']) <= 1.0
        assert 0.3 < float(values['Ground fraction']) < 1.0
        status = b.wait_for_status('output', lambda *_: True)
        values = {entry.key: entry.value for entry in status.values}
        assert values[f'{NAMESPACE}/ground subscribers'] == '1'
        assert values[f'{NAMESPACE}/obstacles since startup'] == '4'
        assert b.set('diagnostics.max_latency', 0.001).successful
        b.wait_for_status('processing', lambda _, s: s.level == DiagnosticStatus.WARN)


def test_diagnostics_come_without_a_clock_under_sim_time():
    with bench(*OFTEN, '-p', 'use_sim_time:=true') as b:
        assert b.node.get_clock().ros_time_is_active
        b.segment(to_message(street(3000)))
        b.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.OK)


def test_error_in_a_report_does_not_end_the_node(monkeypatch):
    with bench(*OFTEN) as b:
        monkeypatch.setattr(b.node, '_outputs', None)
        status = b.wait_for_status('diagnostics', lambda *_: True)
        assert status.level == DiagnosticStatus.ERROR
        assert 'NoneType' in status.message
        monkeypatch.undo()
        b.wait_for_status('output', lambda *_: True)


def test_stamps_that_jump_back_reset_what_was_learned(monkeypatch):
    points = street(3000)
    resets = []
    reset = GroundSegmenter.reset
    with bench(*OFTEN) as b:
        monkeypatch.setattr(GroundSegmenter, 'reset', lambda s: [resets.append(1), reset(s)])
        for seconds in (100, 101, 102):
            b.segment(to_message(points, stamp=(seconds, 0)))
        assert resets == []
        for seconds in (100, 101, 100):
            b.segment(to_message(points, stamp=(seconds, 0)))
        status = b.wait_for_status('input', lambda v, _: v['Time jumps since startup'] == '2')
        assert status.level == DiagnosticStatus.OK
        assert resets == [1, 1]


def test_simulated_time_that_jumps_back_resets_what_was_learned():
    with bench(*OFTEN, '-p', 'use_sim_time:=true') as b:
        publisher = b.probe.create_publisher(Clock, '/clock', RELIABLE)
        wait_for(lambda: publisher.get_subscription_count() == 1, 'subscription of /clock')

        def tell(seconds):
            message = Clock()
            message.clock.sec = seconds
            publisher.publish(message)
            now = Time(seconds=seconds, clock_type=ClockType.ROS_TIME)
            wait_for(lambda: b.node.get_clock().now() == now, f'time {seconds}')

        tell(1317383000)
        b.segment(to_message(street(3000), stamp=(1317382999, 500000000)))
        # A stamp of 2011 is half a second old: ages are on the node's clock.
        status = b.wait_for_status('input', lambda v, _: v['Events since startup'] == '1')
        values = {entry.key: entry.value for entry in status.values}
        assert values['Age of last stamp (s)'] == '0.500'
        assert values['Clock'] == 'simulated, from /clock'
        tell(1317382000)
        b.wait_for_status('input', lambda v, _: v['Time jumps since startup'] == '1')
        # The first cloud of the next round: the same jump.
        b.segment(to_message(street(3000), stamp=(1317382000, 0)))
        status = b.wait_for_status('input', lambda v, _: v['Events since startup'] == '2')
        values = {entry.key: entry.value for entry in status.values}
        assert values['Time jumps since startup'] == '1'


def test_drops_are_counted_exactly():
    message = to_message(street(20_000))
    with bench(*OFTEN, '-p', f'qos_overrides.{NAMESPACE}/points.subscription.depth:=1') as b:
        b.segment(message)
        for _ in range(29):
            b.publisher.publish(message)

        def all_accounted_for(values, _status):
            return int(values['Clouds since startup']) + int(values['Dropped since startup']) == 30

        status = b.wait_for_status('processing', all_accounted_for)
        values = {entry.key: entry.value for entry in status.values}
        assert int(values['Dropped since startup']) > 0
        assert int(values['Clouds since startup']) == len(b.ground.wait(2))


def publish_until(publisher, message, condition, what):
    def publish_once():
        publisher.publish(message)
        return condition()

    wait_for(publish_once, what)


def test_input_follows_the_reliability_of_its_publishers():
    message = to_message(street(1000))
    with bench() as b:
        b.in_executor(b.probe.destroy_publisher, b.publisher)
        driver = b.probe.create_publisher(PointCloud2, 'points', BEST_EFFORT)
        publish_until(driver, message, lambda: b.ground.messages, 'cloud of a best-effort driver')
        assert b.node._input.qos.reliability == BEST_EFFORT.reliability

        # The driver ends, a bag is played: nothing of it may be lost.
        b.in_executor(b.probe.destroy_publisher, driver)
        player = b.probe.create_publisher(PointCloud2, 'points', RELIABLE)
        wait_for(
            lambda: b.node._input.qos.reliability == RELIABLE.reliability, 'reliable subscription'
        )
        wait_for(lambda: player.get_subscription_count() == 1, 'match')
        count = len(b.ground.messages)
        player.publish(message)
        b.ground.wait(count + 1)


@pytest.mark.parametrize('reliability', ['reliable', 'best_effort'])
def test_reliability_asked_for_is_kept(reliability):
    override = f'qos_overrides.{NAMESPACE}/points.subscription.reliability:={reliability}'
    depth = f'qos_overrides.{NAMESPACE}/points.subscription.depth:=9'
    message = to_message(street(1000))
    with bench('-p', override, '-p', depth, *OFTEN) as b:
        b.segment(message)
        driver = b.probe.create_publisher(PointCloud2, 'points', BEST_EFFORT)
        b.wait_for_status('input', lambda v, _: v['Publishers'] == '2')
        publish_until(
            driver, message, lambda: len(b.diagnostics.messages) > 15, 'a second of clouds'
        )
        assert b.node._input.qos.reliability.name.lower() == reliability
        assert b.node._input.qos.depth == 9


def test_two_nodes_side_by_side():
    message = to_message(street(1000))
    with isolated_context() as context:
        b = Bench(context, ('-r', '__node:=front', '-p', 'label.ground_tolerance:=0.5'))
        rear = GroundSegmentationNode(
            context=context,
            namespace=f'{NAMESPACE}/rear',
            cli_args=['--ros-args', '-r', 'points:=cloud', '-r', 'ground:=floor'],
        )
        floor = Collector(b.probe, PointCloud2, 'rear/floor')
        publisher = b.probe.create_publisher(PointCloud2, 'rear/cloud', RELIABLE)
        assert b.node.get_name() == 'front'
        with spinning(context, b.node, b.probe, rear):
            wait_for(lambda: publisher.get_subscription_count() == 1, 'subscription')
            wait_for(lambda: floor.n_publishers == 1, 'floor')
            publisher.publish(message)
            floor.wait(1)
            wait_for(lambda: b.publisher.get_subscription_count() == 1, 'subscription')
            b.publisher.publish(message)
            b.ground.wait(1)
            assert len(floor.messages) == 1
        assert b.node.config.label.ground_tolerance == 0.5
        assert rear.config.label == Config().label


def test_names_of_the_diagnostics():
    """Dashboards read them: tasks, keys and their order are part of the interface."""
    times = [
        f'{name} p{percent} (ms)'
        for name in ('Latency', *(f'Stage {stage}' for stage in STAGES))
        for percent in (50, 95, 99)
    ]
    with bench(*OFTEN) as b:
        b.segment(to_message(street(3000)))
        tasks = {
            task: b.wait_for_status(task, lambda v, _, key=key: v.get(key) not in (None, '0'))
            for task, key in FIRST_COUNTERS.items()
        }
        node_name = b.node.get_fully_qualified_name()
    keys = {task: [entry.key for entry in status.values] for task, status in tasks.items()}
    assert {status.hardware_id for status in tasks.values()} == {'none'}
    assert keys['input'] == INPUT_KEYS.split('; ')
    assert sorted(keys['processing']) == sorted([*PROCESSING_KEYS.split('; '), *times])
    model = [key for key in keys['model'] if not key.startswith('theta ')]
    assert model == MODEL_KEYS.split('; ')
    assert len(keys['model']) > len(model)
    topics = [f'{NAMESPACE}/ground', f'{NAMESPACE}/obstacles'] + [
        f'{node_name}/{name}' for name in ('labeled', 'ground_model', 'markers')
    ]
    facts = ('subscribers', 'rate (Hz)', 'since startup')
    assert keys['output'] == [f'{topic} {fact}' for topic in topics for fact in facts]


FIRST_COUNTERS = {
    'input': 'Events since startup',
    'processing': 'Clouds since startup',
    'model': 'Candidates',
    'output': f'{NAMESPACE}/ground since startup',
}
STAGES = (
    'queue', 'grid', 'pose', 'faces', 'lines', 'learning', 'surface', 'label', 'total', 'publish',
)  # fmt: skip
INPUT_KEYS = (
    'Topic; Publishers; QoS; Events since startup; Events in window; Duration of window (s); '
    'Actual frequency (Hz); Time since last cloud (s); Age of last stamp (s); Clock; '
    'Time jumps since startup; Frame; Fields; Refused since startup; Last error'
)
PROCESSING_KEYS = (
    'Clouds since startup; Clouds in window; Dropped since startup; Load (%); Backend; Threads'
)
MODEL_KEYS = (
    'frame_quality; Segments with a model; Segments with candidates; Ground fraction; '
    'Unknown fraction; Fraction without model; Label certainty; Candidates; Inliers; '
    'Sensor height (m); Sensor roll (rad); Sensor pitch (rad); Taken from the scan; '
    'Estimated height (m); Estimated roll (rad); Estimated pitch (rad); Noise (m); '
    'Learning mode; Learned since startup; Optimiser status; Evaluations; At bound; '
    'Objective per candidate'
)
