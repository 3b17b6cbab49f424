"""The command `play`, by what a subscriber gets of it and by what it says."""

import contextlib
import functools
import itertools
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import ros_helpers as ros
from bag_samples import PERIOD, START, write_ros1_bag, write_ros2_bag
from cli_runner import PATIENCE, error_line, run, start, wait_for
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_helpers import isolated_context, spinning
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.cli import options
from gp_ground_seg.data.bags import BagReader, decode_cloud, stamp_of
from gp_ground_seg.ros import playback, start_stop

RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
SUMMARY = re.compile(r'(\d+) clouds? sent in ([\d.]+) s\n')
WAITING = 'gp-ground-seg: note: waiting for a subscriber of /points'


@pytest.fixture(autouse=True)
def stock_transport(monkeypatch):
    """Fast DDS would keep a profile for all that follows in this process."""
    monkeypatch.setattr(start_stop, '_free_shared_memory', lambda: 0)


class Listener:
    """Subscribes to clouds and /clock; keeps the bytes, and when they were sent [ns]."""

    def __init__(self, context, topics, qos):
        self.node = Node('listener', context=context)
        self.clouds = {topic: [] for topic in topics}
        self.times = {topic: [] for topic in topics}
        self.clock = []
        self.subscriptions = [self._subscribe(topic, qos) for topic in topics]
        self.node.create_subscription(Clock, '/clock', self._tick, RELIABLE)

    def _subscribe(self, topic, qos):
        def receive(raw, info):
            self.times[topic].append(info['source_timestamp'])
            self.clouds[topic].append(raw)

        return self.node.create_subscription(PointCloud2, topic, receive, qos, raw=True)

    def _tick(self, message):
        self.clock.append(message.clock.sec * 10**9 + message.clock.nanosec)


@contextlib.contextmanager
def listening(*topics, qos=RELIABLE):
    with isolated_context() as context:
        listener = Listener(context, topics, qos)
        with spinning(context, listener.node):
            yield listener


def drive(folder, n_clouds, **options):
    write_ros2_bag(folder / 'drive.mcap', n_clouds, **options)
    return folder / 'drive.mcap'


play = functools.partial(run, 'play')


def summary(capsys):
    """Numbers of its line: clouds, seconds."""
    return [float(number) for number in SUMMARY.fullmatch(capsys.readouterr().out).groups()]


def recorded(bag, topic):
    with BagReader(bag) as reader:
        return [raw for _, _, raw in reader.messages([topic])]


def test_every_byte_at_the_recorded_times(tmp_path, capsys, monkeypatch):
    bag = drive(tmp_path, 8)
    told, late = [], []
    wait = playback.Player._wait_until

    def wait_until(player, due, now):
        wait(player, due, now)
        late.append(time.monotonic() - due)

    monkeypatch.setattr(playback.Player, '_wait_until', wait_until)
    tell = playback.Player._publish_time
    monkeypatch.setattr(
        playback.Player, '_publish_time', lambda p, now: [told.append(now), tell(p, now)]
    )
    end = START + 7 * PERIOD
    with listening('/points') as listener:
        assert play(bag, '--clock', '--rate', 2) == 0
        wait_for(lambda: len(listener.clouds['/points']) == 8, 'last cloud')
        wait_for(lambda: listener.clock[-1:] == [end], 'end of /clock')
    assert listener.clouds['/points'] == recorded(bag, '/points')
    captured = capsys.readouterr()
    note, *waiting = captured.err.splitlines()
    assert note == 'gp-ground-seg: note: not played: /note (std_msgs/msg/String)'
    assert set(waiting) <= {WAITING}
    numbers = SUMMARY.fullmatch(captured.out).groups()
    assert numbers[0] == '8'
    # How late a cloud is the machine decides, not we.
    delay = max(late)
    assert float(numbers[1]) == pytest.approx(7 * 0.05, abs=0.06 + delay)

    # No cloud before its time, counted from the first, which may be late itself.
    times = np.array(listener.times['/points'])
    due = np.arange(8) * PERIOD / 2
    assert (times - times[0] - due > -1e9 * (0.02 + delay)).all()

    # A newer time may take the place of one not sent yet.
    assert set(listener.clock) <= set(told)
    assert listener.clock == sorted(listener.clock)
    assert told == sorted(told)
    assert (told[0], told[-1]) == (START, end)
    assert set(START + np.arange(8) * PERIOD) <= set(told)
    # 50 times a second, of which each lasts two of the bag's.
    assert np.median(np.diff(told)) <= 2 * 0.03e9 + 2e9 * delay


def test_which_topics(tmp_path, capsys):
    bag = drive(tmp_path, 2, topics=('/front', '/rear'))
    with listening('/front', '/rear') as listener:
        assert play(bag, '--quiet') == 2
        assert 'choose one with --topic: /front, /rear' in capsys.readouterr().err
        assert play(bag, '--topic', '/rear', '--quiet') == 0
        wait_for(lambda: len(listener.clouds['/rear']) == 2, 'last cloud')
        assert listener.clouds['/front'] == []
        assert summary(capsys)[0] == 2

        assert play(bag, '--topic', '/front', '--topic', '/rear', '--quiet', '--rate', 0.5) == 0
        wait_for(lambda: [len(c) for c in listener.clouds.values()] == [2, 4], 'last cloud')
        numbers = summary(capsys)
    assert numbers[0] == 4
    # Two clouds on each topic, 0.2 s apart; a busy machine may send them late.
    assert numbers[1] >= 0.1


def test_bag_of_ros_1_on_another_topic_for_a_best_effort_subscriber(tmp_path, capsys):
    bag = tmp_path / 'kitti.bag'
    write_ros1_bag(bag, 2)
    with listening('/points', qos=ros.BEST_EFFORT) as listener:
        remap = '/kitti/velo/pointcloud:=/points'
        sent = recorded(bag, '/kitti/velo/pointcloud')
        # DDS may lose a cloud for a best-effort subscriber; in one of two plays it does not.
        for _ in range(2):
            listener.clouds['/points'].clear()
            assert play(bag, '--quiet', '--ros-args', '-r', remap) == 0
            time.sleep(0.5)
            assert all(cloud in sent for cloud in listener.clouds['/points'])
            if listener.clouds['/points'] == sent:
                break
    assert listener.clouds['/points'] == sent
    assert decode_cloud(sent[0]).header.frame_id == 'velo_link'


def test_nobody_listens(tmp_path, capsys):
    with isolated_context():
        assert play(drive(tmp_path, 1), '--no-wait', '--quiet') == 0
    assert capsys.readouterr().out == '1 cloud sent in 0.0 s\n'


def test_waits_and_says_so(tmp_path, monkeypatch):
    notes = []
    monkeypatch.setattr(options, 'note', notes.append)
    with ros.isolated(), ThreadPoolExecutor(1) as pool:
        played = pool.submit(play, drive(tmp_path, 2))
        wait_for(lambda: 'waiting for a subscriber of /points' in notes, 'note')
        with listening('/points') as listener:
            wait_for(lambda: len(listener.clouds['/points']) == 2, 'last cloud')
            assert played.result(PATIENCE) == 0


def test_loop_until_interrupted(tmp_path):
    words = 'play', drive(tmp_path, 3), '--loop', '--rate', 2, '--clock'
    with listening('/points') as listener, start(*words) as process:
        try:
            wait_for(lambda: len(listener.clouds['/points']) >= 7, 'third round')
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
        wait_for(lambda: listener.subscriptions[0].get_publisher_count() == 0, 'farewell')
    assert process.returncode == 130
    assert errors.splitlines()[-1] == 'gp-ground-seg: interrupted'
    assert 'Traceback' not in errors
    numbers = SUMMARY.fullmatch(output).groups()
    assert int(numbers[0]) >= 7
    stamps = [stamp_of(decode_cloud(raw)) for raw in listener.clouds['/points']]
    assert stamps == list(itertools.islice(itertools.cycle(stamps[:3]), len(stamps)))
    # In each round the clock of the bag begins again.
    assert (np.diff(listener.clock) < 0).sum() >= 2
    # A period between the last of a round and the first of the next, as between the others.
    steps = np.diff(listener.times['/points'])
    assert np.median(steps) > 0.5 * PERIOD / 2


SUBSCRIBER = """
import os, rclpy, signal
from sensor_msgs.msg import PointCloud2
rclpy.init()
node = rclpy.create_node('doomed')
seen = []

def receive(cloud):
    seen.append(cloud)
    if len(seen) == 3:
        os.kill(os.getpid(), signal.SIGKILL)

node.create_subscription(PointCloud2, '/points', receive, 10)
rclpy.spin(node)
"""


def test_subscriber_that_is_killed(tmp_path, capsys, monkeypatch):
    """It cannot say goodbye: the middleware believes in it, but no longer hears of it."""
    monkeypatch.setattr(playback, 'DELIVERY_TIMEOUT', 0.5)
    send, sent = playback.Player._send, []

    def note(player, topic, raw):
        sent.append(time.monotonic())
        send(player, topic, raw)

    monkeypatch.setattr(playback.Player, '_send', note)
    bag, command = drive(tmp_path, 20), [sys.executable, '-c', SUBSCRIBER]
    environment = {**os.environ, **ros.ISOLATION}
    with subprocess.Popen(command, env=environment) as subscriber, isolated_context():
        assert play(bag) == 1
        assert subscriber.wait(PATIENCE) == -signal.SIGKILL
    assert time.monotonic() - sent[-1] > 0.5
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.endswith('not every reliable subscriber has acknowledged all clouds')


def test_refused(tmp_path, capsys):
    bag = drive(tmp_path, 1)
    for words, said in (
        ([bag, '--rate', 0], 'play: --rate: '),
        ([bag, '--rate', 'nan'], 'play: --rate: '),
        ([tmp_path / 'none.mcap'], f'{tmp_path / "none.mcap"}: no such file or folder'),
        ([bag, '--quiet', '--ros-args', '-r', 'nonsense'], ''),
    ):
        assert play(*words) == 2
        assert error_line(capsys).startswith(said)
