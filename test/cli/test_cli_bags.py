"""The command `play`, by what a subscriber gets of it and by what it says."""

import contextlib
import functools
import itertools
import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import ros_helpers as ros
from bag_samples import PERIOD, START, read_messages, write_ros2_bag
from cli_runner import PATIENCE, error_line, run, until_ctrl_c, wait_for
from rclpy.node import Node
from ros_helpers import Collector, isolated_context, spinning
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.cli import bags
from gp_ground_seg.data.bags import decode_cloud
from gp_ground_seg.data.point_cloud2 import stamp_of
from gp_ground_seg.ros import session


@pytest.fixture(autouse=True)
def patient_play(monkeypatch):
    """With stock transport: Fast DDS would keep a profile for all that follows here."""
    monkeypatch.setattr(session, '_free_shared_memory', lambda: 0)
    for name in ('DISCOVERY_TIMEOUT', 'DELIVERY_TIMEOUT'):
        monkeypatch.setattr(bags, name, PATIENCE)


@contextlib.contextmanager
def listening(*topics):
    """Bytes of the clouds on each topic, when they were sent, and times of /clock [ns]."""
    with isolated_context() as context:
        node = Node('listener', context=context)
        heard = SimpleNamespace(clouds={t: [] for t in topics}, times={t: [] for t in topics})

        def receive(raw, info, topic):
            heard.times[topic].append(info['source_timestamp'])
            heard.clouds[topic].append(raw)

        for topic in topics:
            take = functools.partial(receive, topic=topic)
            node.create_subscription(PointCloud2, topic, take, ros.RELIABLE, raw=True)
        clock = Collector(node, Clock, '/clock')
        with spinning(context, node):
            heard.clock = lambda: [m.clock.sec * 10**9 + m.clock.nanosec for m in clock.messages]
            heard.n_publishers = lambda: sum(map(node.count_publishers, topics))
            yield heard


def wait_for_clouds(clouds, n):
    wait_for(lambda: len(clouds) >= n, f'cloud {n}')


def drive(folder, n_clouds, **options):
    write_ros2_bag(folder / 'drive.mcap', n_clouds, **options)
    return folder / 'drive.mcap'


play = functools.partial(run, 'play')


def recorded(bag, topic):
    return [raw for _, _, raw in read_messages(bag, topic)]


def test_every_byte_of_every_topic_at_the_recorded_times(tmp_path):
    """One of them on another topic."""
    bag = drive(tmp_path, 8, topics=('/front', '/rear'))
    end = START + 7 * PERIOD
    with listening('/front', '/back') as listener:
        remap = '--ros-args', '-r', '/rear:=/back'
        assert play(bag, '--clock', '--rate', 2, *remap) == 0
        for clouds in listener.clouds.values():
            wait_for_clouds(clouds, 8)
        wait_for(lambda: listener.clock()[-1:] == [end], 'end of /clock')
    for topic, clouds in listener.clouds.items():
        assert clouds == recorded(bag, topic.replace('back', 'rear'))
        # None before its time, counted from the first, which a busy machine sends late.
        times = np.array(listener.times[topic])
        assert (times[1:] - times[0] > np.arange(7) * PERIOD / 2).all()
    clock = listener.clock()
    assert clock == sorted(clock) and clock[0] >= START


def test_loop_until_interrupted(tmp_path):
    words = 'play', drive(tmp_path, 3), '--loop', '--rate', 2, '--clock', '--quiet'
    with listening('/points') as listener:
        with until_ctrl_c(*words):
            wait_for_clouds(listener.clouds['/points'], 7)
            wait_for(lambda: any((t - START) % PERIOD for t in listener.clock()), 'time between')
        wait_for(lambda: listener.n_publishers() == 0, 'farewell')
    stamps = [stamp_of(decode_cloud(raw).header) for raw in listener.clouds['/points']]
    assert stamps == list(itertools.islice(itertools.cycle(stamps[:3]), len(stamps)))
    # It is the time of the bag, also between clouds, and in each round begins again.
    assert (np.diff(listener.clock()) < 0).sum() >= 2
    # A period between the last of a round and the first of the next, as between the others.
    assert np.median(np.diff(listener.times['/points'])) > 0.5 * PERIOD / 2


SUBSCRIBER = """
import os, rclpy, signal
from sensor_msgs.msg import PointCloud2
rclpy.init()
node = rclpy.create_node('doomed')
kill = lambda cloud: os.kill(os.getpid(), signal.SIGKILL)
node.create_subscription(PointCloud2, '/points', kill, 10)
rclpy.spin(node)
"""


def test_it_ends_without_a_subscriber_and_with_one_that_is_killed(tmp_path, monkeypatch):
    """It cannot say goodbye: the middleware waits for its acknowledgements."""
    bag, deliver = drive(tmp_path, 5), session.Session.wait_until_delivered
    with isolated_context():
        with monkeypatch.context() as patch:
            patch.setattr(bags, 'DISCOVERY_TIMEOUT', 0.1)
            assert play(bag, '--quiet') == 0
        command, environment = [sys.executable, '-c', SUBSCRIBER], {**os.environ, **ros.ISOLATION}
        with subprocess.Popen(command, env=environment) as subscriber:

            def deliver_to_the_dead(*words):
                assert subscriber.wait(PATIENCE) == -signal.SIGKILL
                return deliver(*words[:2], 0.5)

            monkeypatch.setattr(session.Session, 'wait_until_delivered', deliver_to_the_dead)
            assert play(bag, '--quiet') == 0


def test_words_that_ros_refuses(tmp_path, capsys):
    assert play(drive(tmp_path, 1), '--quiet', '--ros-args', '-r', 'nonsense') == 2
    assert 'nonsense' in error_line(capsys)
