"""Several publishers on the input: each cloud once, losses of each, clouds too large to trust."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('rclpy', reason='ROS is not installed')

import ros_helpers as ros
from diagnostic_msgs.msg import DiagnosticStatus
from ros_helpers import BEST_EFFORT, NAMESPACE, RELIABLE, street, to_message, wait_for
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.ros.subscription import SequenceGaps

# A busy machine must not look like a fault.
CHANGES = {
    'learning.mode': 'fixed', 'runtime.backend': 'numpy', 'grid.n_segments': 16,
    'diagnostics.period': 0.2, 'diagnostics.recover_after': 0.0, 'diagnostics.max_latency': 10.0,
    'diagnostics.max_load': 100.0, 'diagnostics.stale_after': 60.0,
}  # fmt: skip
BOTH = 'reliable, keep_last 5, volatile; best_effort from 1 of 2 publishers'
LARGE = to_message(street(30_000))
"""A cloud of 1.9 MB."""


@pytest.fixture
def started(tmp_path):
    """A node in its own process, and a link that publishes reliably."""
    with ros.linked_process(tmp_path, *ros.given(CHANGES)) as (node, link):
        yield node, link


def add_publisher(link, qos):
    """Another publisher, known to the node."""
    publisher = link.probe.create_publisher(PointCloud2, 'points', qos)
    wait_for(lambda: publisher.get_subscription_count() == 1, 'subscription')
    return publisher


def stamped(number):
    return to_message(street(200), stamp=(1000, 1000 * number))


def numbers(messages):
    return [message.header.stamp.nanosec // 1000 for message in messages]


def test_a_silent_best_effort_publisher_costs_a_reliable_one_nothing(started):
    node, link = started
    add_publisher(link, BEST_EFFORT)
    link.wait_for_status('input', lambda v, _: 'best_effort' in v['QoS'])
    for _ in range(20):
        link.segment(LARGE)
    status = link.wait_for_status('processing', lambda v, _: v['Clouds since startup'] == '20')
    assert ros.values_of(status)['Dropped since startup'] == '0'
    status = link.wait_for_status('input', lambda *_: True)
    assert (status.level, status.message) == (DiagnosticStatus.OK, 'receiving')
    assert ros.values_of(status)['QoS'] == BOTH
    assert len(link.ground.messages) == 20
    assert 'WARN' not in node.log


def test_each_cloud_of_both_kinds_is_taken_once_and_in_order(started):
    _, link = started
    second = add_publisher(link, BEST_EFFORT)
    link.wait_for_status('input', lambda v, _: v['QoS'] == BOTH)
    for k in range(0, 60, 4):
        for number in (k, k + 1):
            second.publish(stamped(number))
        for number in (k + 2, k + 3):
            link.publisher.publish(stamped(number))
        link.ground.wait(k + 4)
    # Without the reliable one: no cloud waits for it.
    link.probe.executor.create_task(link.probe.destroy_publisher, link.publisher)
    link.wait_for_status('input', lambda v, _: v['QoS'].startswith('best_effort, keep_last 5'))
    second.publish(stamped(60))
    link.ground.wait(61)
    found = numbers(link.ground.messages)
    assert sorted(found) == list(range(61))
    for kind in (0, 2):
        own = [number for number in found if number % 4 in (kind, kind + 1)]
        assert all(one < next_one for one, next_one in pairwise(own))


@pytest.mark.parametrize('qos', [RELIABLE, BEST_EFFORT])
def test_losses_of_two_publishers_are_counted(started, qos):
    _, link = started
    second = add_publisher(link, qos)
    link.wait_for_status('input', lambda v, _: v['Publishers'] == '2')
    message = to_message(street(2000))
    for n_clouds in (1, 40, 1):
        for _ in range(n_clouds):
            link.publisher.publish(message)
            second.publish(message)
        status = wait_until_quiet(link)
    values = ros.values_of(status)
    n_dropped, n_processed = (int(values[f'{k} since startup']) for k in ('Dropped', 'Clouds'))
    assert n_dropped > 20
    assert n_dropped + n_processed == 2 * 42


def wait_until_quiet(link):
    """The status of processing, once a second has brought no answer."""
    while True:
        count, start = len(link.ground.messages), len(link.diagnostics.messages)
        link.diagnostics.wait(start + 5)
        if 0 < count == len(link.ground.messages):
            return link.wait_for_status('processing', lambda *_: True)


def test_large_clouds_that_come_best_effort_are_a_warning(tmp_path):
    with ros.linked_process(tmp_path, *ros.given(CHANGES), sends=BEST_EFFORT) as (node, link):
        link.publish_until(LARGE, lambda: len(link.ground.messages) >= 2, 'answer')
        status = link.wait_for_status('input', lambda _, s: s.level == DiagnosticStatus.WARN)
        assert 'clouds of 1.9 MB come best-effort' in status.message
        assert 'FASTRTPS_DEFAULT_PROFILES_FILE' in status.message
        (line,) = [line for line in node.log.splitlines() if 'come best-effort' in line]
        assert '[WARN]' in line and f'{NAMESPACE}/points' in line


def test_a_cloud_above_the_limit_is_refused_and_the_next_answered(tmp_path):
    words = ros.given({**CHANGES, 'input.max_cloud_size': 1})
    small = to_message(street(500))
    with ros.linked_process(tmp_path, *words) as (node, link):
        link.segment(small)
        link.publisher.publish(LARGE)
        status = link.wait_for_status('input', lambda v, _: v['Refused since startup'] == '1')
        assert status.level == DiagnosticStatus.ERROR
        said = 'cloud of 1.9 MB: must be at most input.max_cloud_size = 1 MB'
        assert ros.values_of(status)['Last error'] == said
        assert said in node.log
        link.segment(small)
        assert len(link.ground.messages) == 2
        assert link.set('input.max_cloud_size', 2).successful
        parts = link.segment(LARGE)
        assert sum(part.width for part in parts) == LARGE.width


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 5)), max_size=50), st.booleans())
def test_gaps_of_two_publishers_add_up(steps, are_near):
    gaps, last = SequenceGaps(), [1000, 1000 if are_near else 1]
    assert [gaps.note(number, 2) for number in last] == [0, 0]
    counted = lost = 0
    for which, n_lost in steps:
        # Numbers that are near and have holes may be those of either.
        n_lost = 0 if are_near else n_lost
        last[which] += 1 + n_lost
        counted += gaps.note(last[which], 2)
        lost += n_lost
    assert counted == lost


def test_a_message_that_comes_late_was_not_lost():
    gaps = SequenceGaps()
    for number in (10, 5000):
        assert gaps.note(number, 2) == 0
    # 5001 to 5003 are missing, and two of them come late.
    counts = [gaps.note(number, 2) for number in (5004, 11, 5002, 12, 5001, 5005, 14)]
    assert counts == [3, 0, -1, 0, -1, 0, 1]
