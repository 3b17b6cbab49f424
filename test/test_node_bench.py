"""Losses and latency of a real node in a second process, small and short."""

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

import node_bench
import numpy as np
import ros_helpers  # noqa: F401  imports type support, which warns
from conftest import hilly_scan

from gp_ground_seg.cli.bags import scan_cloud
from gp_ground_seg.core.errors import GroundSegError


@pytest.fixture
def clouds():
    scans = [np.zeros((6000, 4), np.float32) for _ in range(3)]
    for k, scan in enumerate(scans):
        scan[:, :3] = hilly_scan(6000, seed=k)
    return [scan_cloud(scan, 0, 'lidar') for scan in scans]


@pytest.mark.slow
def test_losses_are_reported(clouds):
    words = ['-p', 'learning.mode:=fixed']
    slow, fast = rates = node_bench.measure(clouds, [5.0, 1000.0], 30, words)
    assert (slow['n_sent'], fast['n_sent']) == (30, 30)
    # Clouds that take some milliseconds, 1 ms apart: the oldest have to go.
    assert fast['n_lost'] > 0
    for rate in rates:
        assert rate['n_lost'] == rate['n_dropped'] == rate['n_sent'] - rate['n_back']
        assert 0.0 < rate['p50'] <= rate['p95'] <= rate['p99'] <= rate['worst']
    assert slow['n_lost'] == 0


def test_a_node_that_cannot_start_is_an_error(clouds):
    with pytest.raises(GroundSegError, match='the node ended with code 2') as caught:
        node_bench.measure(clouds, [5.0], 30, ['-p', 'label.ground_tolerance:=9.0'])
    assert 'label.ground_tolerance = 9.0' in str(caught.value)
