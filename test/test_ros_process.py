"""The node in a process of its own: transport, signals, command line."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

from rclpy.node import Node
from ros_helpers import (
    BEST_EFFORT,
    ISOLATION,
    MODULE,
    NAMESPACE,
    Collector,
    Link,
    Process,
    isolated_context,
    rows_of,
    spinning,
    street,
    to_message,
    wait_for,
    xyz_of,
)
from sensor_msgs.msg import PointCloud2

from gp_ground_seg import Config, GroundSegmenter, Label

# These tests are about transport, signals and words: the cheapest model will do.
CHEAP = Config().replace(**{'learning.mode': 'fixed'})
IN_NAMESPACE = ('--ros-args', '-r', f'__ns:={NAMESPACE}', '-p', 'learning.mode:=fixed')
REPOSITORY = Path(__file__).parents[1]
PROFILE = REPOSITORY / 'config' / 'fastdds_large_clouds.xml'


def test_clouds_of_two_megabytes_at_10_hz_all_come_back(tmp_path):
    points = street(30_000, n_invalid=100)
    message = to_message(points, frame='velo_link')
    assert len(message.data) == 1_920_000
    with Process(*IN_NAMESPACE, folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_settled()
        link = Link(context)
        with spinning(context, link.probe):
            link.wait_until_connected()
            next_time = time.monotonic()
            for k in range(20):
                message.header.stamp.sec = k
                link.publisher.publish(message)
                next_time += 0.1
                time.sleep(max(0.0, next_time - time.monotonic()))
                # Slower only where the machine is too busy for 10 Hz: more than the queue of
                # the node can hold would rightly be dropped.
                link.ground.wait(k - 3)
            link.ground.wait(20)
            link.obstacles.wait(20)
            time_stamps = [
                [part.header.stamp.sec for part in collector.messages]
                for collector in (link.ground, link.obstacles)
            ]
            assert time_stamps == [list(range(20))] * 2

    label = GroundSegmenter(CHEAP).segment(xyz_of(points)).label
    rows = rows_of(message)
    for collector, wanted in ((link.ground, Label.GROUND), (link.obstacles, Label.OBSTACLE)):
        expected = [row for row, found in zip(rows, label, strict=True) if found == wanted]
        for part in collector.messages:
            assert part.fields == message.fields
            assert part.header.frame_id == 'velo_link'
            assert rows_of(part) == expected


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


def test_best_effort_driver_with_the_large_segment_profile(tmp_path):
    environment = {
        **os.environ,
        **ISOLATION,
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILE),
    }
    with Process(*IN_NAMESPACE, folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_ready()
        probe = Node('probe', context=context, namespace=NAMESPACE)
        ground = Collector(probe, PointCloud2, 'ground')
        with (tmp_path / 'driver.log').open('wb') as log:
            driver = subprocess.Popen(
                [sys.executable, '-c', DRIVER, NAMESPACE], env=environment, stderr=log
            )
        try:
            with spinning(context, probe):
                ground.wait(5)
            assert driver.poll() is None
        finally:
            driver.kill()
            driver.wait()
        # Fast DDS only warns about a profile that it cannot read, and goes on without.
        assert 'XML' not in (tmp_path / 'driver.log').read_text()
        assert 'best_effort' in node.log


def test_best_effort_driver_with_small_clouds(tmp_path):
    message = to_message(street(2000))
    with Process(*IN_NAMESPACE, folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_ready()
        link = Link(context, BEST_EFFORT)

        def publish_until_answered():
            link.publisher.publish(message)
            return len(link.ground.messages) >= 5

        with spinning(context, link.probe):
            wait_for(publish_until_answered, 'answer to a best-effort driver')


def test_command_line_hands_ros_arguments_on(tmp_path):
    words = ('--ros-args', '-p', 'label.ground_tolerance:=0.3', '-r', f'__ns:={NAMESPACE}')
    with Process(*words, folder=tmp_path, start=MODULE) as node:
        node.wait_until_ready()
        default = Config().label.ground_tolerance
        assert f'label.ground_tolerance: 0.3 m  (default {default})' in node.log
        assert f'listening to {NAMESPACE}/points' in node.log
        assert node.stop(signal.SIGTERM)[0] == 0


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (('config', 'dump', '--ros-args', '-p', 'a:=1'), '--ros-args: this command takes none'),
        (('node', 'nonsense'), 'nonsense'),
        (('node', '--ros-args', '--', 'nonsense'), 'nonsense'),
    ],
)
def test_words_that_nobody_takes_are_refused(words, complaint):
    result = subprocess.run(
        [sys.executable, '-m', 'gp_ground_seg', *words], capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 2
    assert complaint in result.stderr
    assert 'Traceback' not in result.stderr


def test_missing_ros_is_said_in_one_line():
    hide = "import sys; sys.modules['rclpy'] = None; "
    code = hide + 'from gp_ground_seg.cli.node import main; sys.exit(main())'
    result = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert "pip install 'gp_ground_seg[ros]'" in result.stderr
