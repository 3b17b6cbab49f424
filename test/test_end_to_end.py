"""Frames -> bag -> `play` -> the node, in a process each -> both clouds, compared to the library.

Nothing here knows how the node works: it is started, fed and listened to as a user does.
"""

import contextlib
import subprocess
import sys
import time

import numpy as np
import pytest
from bag_samples import write_ros2_bag

pytest.importorskip('rclpy', reason='ROS is not installed')

from ros_helpers import PATIENCE

from gp_ground_seg import GroundSegmenter, Label
from gp_ground_seg.cli.demo import Tally, check_scan, numbered_cloud
from gp_ground_seg.data.bags import BagReader, BagWriter, cloud_topic
from gp_ground_seg.data.point_cloud2 import (
    decode_cloud,
    encode_cloud,
    read_xyz,
    select_points,
    stamp_of,
)
from gp_ground_seg.ros.lifecycle import large_cloud_transport, ros_session
from gp_ground_seg.ros.probe import GROUND, INPUT, OBSTACLES, NodeProcess, Probe, private_network
from gp_ground_seg.simulation import HDL_64E, SCENES, semantic_kitti_labels, simulate_drive

COMMAND = (sys.executable, '-m', 'gp_ground_seg')


class Machine(Probe):
    """A running node, and what comes out of it."""

    def __init__(self, node, session):
        super().__init__(session, lambda *_: None)
        self._node = node
        self._session = session
        self.back = {GROUND: [], OBSTACLES: []}
        self.connect(node, PATIENCE)

    def arrived(self, topic, cloud, now):
        super().arrived(topic, cloud, now)
        # Not the empty ones that test the connection.
        if cloud.width:
            self.back[topic].append(cloud)

    def _spin_until(self, condition, what):
        end = time.monotonic() + PATIENCE
        while not condition():
            self._node.check()
            assert time.monotonic() < end, f'after {PATIENCE:g} s still no {what}'
            self._session.spin(0.02)

    def play(self, bag, n_clouds, *words):
        """Play a bag with the command; return what it printed."""
        for clouds in self.back.values():
            clouds.clear()
        with subprocess.Popen(
            [*COMMAND, 'play', str(bag), '--wait', f'{PATIENCE:g}', *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as player:
            try:
                # Nothing of this node is lost: were it, this would wait in vain.
                self._spin_until(
                    lambda: min(len(clouds) for clouds in self.back.values()) >= n_clouds,
                    f'{n_clouds} clouds on each topic; came: '
                    f'{[len(clouds) for clouds in self.back.values()]}',
                )
                self._spin_until(lambda: player.poll() is not None, 'end of the player')
            finally:
                player.kill()
            output, errors = player.communicate()
        assert player.returncode == 0, errors
        return output

    def n_dropped(self):
        """What the node itself says that it lost."""
        return self.counters(PATIENCE)[1]


@pytest.fixture(scope='module')
def machine(tmp_path_factory):
    log = tmp_path_factory.mktemp('node') / 'node.log'
    with contextlib.ExitStack() as stack:
        stack.enter_context(private_network())
        # Before the next line: this process keeps the transport that other tests expect.
        session = stack.enter_context(ros_session('test_receiver'))
        stack.enter_context(large_cloud_transport())
        node = stack.enter_context(NodeProcess(log))
        yield Machine(node, session)


def segment_all(clouds):
    segmenter = GroundSegmenter()
    try:
        return [segmenter.segment(read_xyz(cloud)).label for cloud in clouds]
    finally:
        segmenter.close()


def assert_is_what_the_library_says(machine, sent):
    """Order, header, layout and every byte: the clouds are the selection by the labels."""
    labels = segment_all(sent)
    for cloud, label, ground, obstacles in zip(
        sent, labels, machine.back[GROUND], machine.back[OBSTACLES], strict=True
    ):
        assert 0 < np.count_nonzero(label == Label.GROUND) < len(label)
        for value, back in ((Label.GROUND, ground), (Label.OBSTACLE, obstacles)):
            wanted = select_points(cloud, label == value)
            assert bytes(back.data) == bytes(wanted.data)
            for name in ('header', 'fields', 'point_step', 'height', 'width'):
                assert getattr(back, name) == getattr(wanted, name), name
        finite = np.isfinite(read_xyz(cloud)).all(axis=1)
        assert ground.width + obstacles.width == np.count_nonzero(finite)
    return labels


def read_clouds(bag, topic):
    with BagReader(bag) as reader:
        return [decode_cloud(raw) for _, _, raw in reader.messages([topic])]


def test_simulated_street(machine, tmp_path):
    n_frames, n_invalid = 6, 100
    rng = np.random.default_rng(0)
    sent = []
    with BagWriter(tmp_path / 'drive.mcap') as bag:
        bag.add_topic(cloud_topic(INPUT))
        for scan in simulate_drive(SCENES['urban'](5), HDL_64E, n_frames, 8.0, 5):
            points = scan.points.copy()
            invalid = rng.choice(len(points), n_invalid, replace=False)
            points[invalid, rng.integers(0, 3, n_invalid)] = rng.choice(
                [np.nan, np.inf, -np.inf], n_invalid
            )
            stamp = 1_600_000_000_123_456_789 + round(1e9 * scan.time)
            sent.append(numbered_cloud(points, semantic_kitti_labels(scan.kind), stamp))
            bag.write(INPUT, stamp, encode_cloud(sent[-1]))

    output = machine.play(tmp_path / 'drive.mcap', n_frames)
    assert output.startswith(f'{n_frames} clouds sent in 0.')
    assert output.endswith(' 0 undelivered\n')
    assert machine.n_dropped() == 0

    labels = assert_is_what_the_library_says(machine, sent)
    # The same once more, point by point by the number each one carries.
    tally = Tally([stamp_of(cloud) for cloud in sent])
    for cloud, label, ground, obstacles in zip(
        sent, labels, machine.back[GROUND], machine.back[OBSTACLES], strict=True
    ):
        results = {GROUND: ground, OBSTACLES: obstacles}
        is_exact, back = check_scan(cloud, results)
        assert is_exact
        np.testing.assert_array_equal(back, label)
        tally.add(cloud, results)
    assert tally.n_points == sum(cloud.width - n_invalid for cloud in sent)
    assert tally.confusion.iou > 0.9


def test_kitti(machine, kitti, tmp_path):
    n_frames, topic = 6, '/kitti/velo/pointcloud'
    bag = tmp_path / 'drive'
    words = [kitti, '--sequence', '08', bag, '--count', n_frames]
    subprocess.run([*COMMAND, 'kitti-to-bag', *map(str, words)], check=True, capture_output=True)
    output = machine.play(bag, n_frames, '--ros-args', '-r', f'{topic}:={INPUT}')
    assert output.endswith(' 0 undelivered\n')
    assert machine.n_dropped() == 0
    sent = read_clouds(bag, topic)
    assert [field.name for field in sent[0].fields] == ['x', 'y', 'z', 'intensity', 'label']
    assert_is_what_the_library_says(machine, sent)


def test_any_layout(machine, tmp_path):
    """Points with a gap, a 16-bit field at an odd place and meaningful padding."""
    write_ros2_bag(tmp_path / 'odd.db3', 4, topics=(INPUT,))
    machine.play(tmp_path / 'odd.db3', 4)
    assert_is_what_the_library_says(machine, read_clouds(tmp_path / 'odd.db3', INPUT))
