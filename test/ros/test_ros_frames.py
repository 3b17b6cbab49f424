"""Tilt of the sensor by TF, and what of it is seen outside: nothing but better labels."""

import contextlib
import dataclasses
import importlib.util
import math
import struct
import sys
import threading
import time
import types

import numpy as np
import pytest
import ros_helpers as ros
from geometry_msgs.msg import Quaternion, Transform, TransformStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.time import Time
from rooms import ROOM
from ros_helpers import bench, street, to_message, wait_for, xyz_of
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.pipeline.points import rotation
from gp_ground_seg.lab.simulation import VLP_16, simulate_scan
from gp_ground_seg.ros import transforms
from gp_ground_seg.ros.transforms import rotation_of

pytestmark = pytest.mark.usefixtures('compiled_code')

HAS_TF2 = importlib.util.find_spec('tf2_ros') is not None
VALUES = {'learning.mode': 'fixed', 'sensor.height': 1.73}
SEGMENTER = GroundSegmenter(Config().replace(**VALUES))
TILT = 0.35, -0.2


def quaternion(matrix):
    return Quaternion(**dict(zip('xyzw', Rotation.from_matrix(matrix).as_quat(), strict=True)))


def turned_street():
    """A street seen by a tilted sensor: structured points, and the rotation to the level frame."""
    points = street(6000)
    turn = Rotation.from_euler('z', 1.0).as_matrix() @ rotation(*TILT)
    return ros.moved(points, xyz_of(points).astype(np.float64) @ turn), turn


def check_levelled(points, message, parts):
    """Every byte and the header as they came, labels as of the same street seen level."""
    expected = SEGMENTER.segment(xyz_of(points), TILT).label
    rows = ros.rows_of(message)
    for part, wanted in zip(parts, (Label.GROUND, Label.OBSTACLE), strict=True):
        kept = [row for row, label in zip(rows, expected, strict=True) if label == wanted]
        assert ros.rows_of(part) == kept
        assert part.header == message.header
    level = SEGMENTER.segment(xyz_of(street(len(points)))).label
    assert (expected == level).mean() > 0.99
    assert parts[0].width > 1000


@given(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(-3.14, 3.14))
def test_a_quaternion_that_may_be_rounded_is_its_rotation(roll, pitch, yaw):
    turn = Rotation.from_euler('z', yaw).as_matrix() @ rotation(roll, pitch)
    exact = quaternion(turn)
    for scale in (1.0, 1.0003):
        found = rotation_of(Quaternion(**{name: scale * getattr(exact, name) for name in 'xyzw'}))
        np.testing.assert_allclose(found, turn, atol=1e-9)


@pytest.mark.parametrize('w', [0.0, 2.0, math.nan])
def test_what_is_no_rotation_is_refused(w):
    with pytest.raises(PointCloudError, match='quaternion'):
        rotation_of(Quaternion(x=0.0, w=w))


class StandInBuffer:
    """The part of ``tf2_ros.Buffer`` that is used, with what a test puts in.

    tf2_ros has no wheel, nor have its messages; where they are installed, the last test runs them.
    """

    def __init__(self):
        self.known = {}  # matrices of rotations
        self.newest = 100  # stamp up to which it knows all [s]
        self.place = 0.0, 0.0, 0.0
        self.n_cleared = 0

    def lookup_transform(self, target, source, time):
        if (target, source) not in self.known:
            raise LookupError(f'"{target}" passed to lookupTransform does not exist')
        if time.nanoseconds > self.newest * 10**9:
            raise IndexError('would require extrapolation into the future')
        transform = Transform(rotation=quaternion(self.known[target, source]))
        transform.translation.x, transform.translation.y, transform.translation.z = self.place
        header = Header(stamp=(time if time.nanoseconds else Time(seconds=self.newest)).to_msg())
        return types.SimpleNamespace(header=header, transform=transform)

    def clear(self):
        self.n_cleared += 1
        self.known.clear()

    set_transform = set_transform_static = None  # nothing is sent


@pytest.fixture
def tf(monkeypatch):
    """What TF knows."""
    buffer = StandInBuffer()
    parts = types.SimpleNamespace(
        Buffer=lambda: buffer, TransformException=LookupError, ExtrapolationException=IndexError
    )
    monkeypatch.setitem(sys.modules, 'tf2_ros', parts)
    # Any message: none is sent.
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', types.SimpleNamespace(TFMessage=Imu))
    return buffer


def tf_message(stamps, parents, padding=b'\0'):
    """Message of TF as its bytes, with a transform for each stamp [ns] and its parent."""
    content = struct.pack('<I', len(stamps))
    for stamp, parent in zip(stamps, parents, strict=True):
        content += struct.pack('<iI', *divmod(stamp, 10**9))
        for name in (parent.encode() + b'\0', b'lidar\0'):
            content += padding * (-len(content) % 4) + struct.pack('<I', len(name)) + name
        content += padding * (-len(content) % 8) + struct.pack('<7d', *np.arange(7.0))
    return b'\0\1\0\0' + content


NAMES = st.lists(st.text('abcdefghi', min_size=1), min_size=1, max_size=4)


@given(NAMES, st.binary(min_size=1, max_size=1))
def test_transforms_are_kept_by_their_frames(names, padding):
    n, key = len(names), transforms.names_in(tf_message([7 * 10**9 + 5] * len(names), names))
    other = tf_message([3 * 10**9 + 1] * n, names, padding)
    assert transforms.names_in(other) == key
    assert transforms.stamp_in(other, transforms.FIRST_STAMP) == 3 * 10**9 + 1
    for changed in ([*names, 'a'], [names[0] + 'b', *names[1:]]):
        assert transforms.names_in(tf_message([1] * len(changed), changed)) != key
    # One whose stamps differ is read at once.
    assert not transforms.names_in(tf_message([*range(n + 1)], [*names, 'a']))


@given(st.lists(st.integers(1, 10**10), min_size=1), st.integers(1, 10**10))
def test_of_transforms_those_around_a_stamp_are_read_once(stamps, stamp):
    kept, n_before = transforms.Kept(), sum(own < stamp for own in stamps)
    for own in stamps:
        kept.add(own, b'%d' % own)
    wanted = sorted(stamps)[max(n_before - 1, 0) : n_before + 1]
    assert [int(message) for message in kept.read(stamp)] == wanted
    assert not kept.read(stamp) and len(kept.read(0)) == len(stamps) - len(wanted)
    kept.add(4 * transforms.KEPT_TIME, b'new')
    assert kept.read(0) == [b'new'] and len(kept) == 1


def cloud_of(points, seconds, nanosec=0):
    return to_message(points, stamp=(seconds, nanosec), frame='tilted_lidar')


def test_tilt_by_tf_is_as_good_as_given(tf):
    points, turn = turned_street()
    with bench({**VALUES, 'frame.level': 'tf'}) as b:
        # Not known yet: refused with the names of both frames, and the node goes on.
        b.publisher.publish(cloud_of(points, 3))
        status = b.wait_for_status('input', lambda v, s: 'no transform' in s.message)
        assert "'tilted_lidar'" in status.message
        assert "frame.base = 'base_link'" in status.message
        tf.known['base_link', 'tilted_lidar'] = turn
        # Of a frame that is sent no more, such as that of a person.
        b.node._frames._transforms[b'gone'].add(1, b'')
        # The second is newer than what TF knows: the newest is taken. And back by a little: all is
        # kept.
        for message in (
            cloud_of(points, 3),
            cloud_of(points, 1000),
            cloud_of(points, 999, 4 * 10**8),
        ):
            check_levelled(points, message, b.segment(message))
        assert not tf.n_cleared and not b.node._frames._transforms
        # Back to the start of a bag what moved is forgotten, and clouds are refused until TF sends
        # anew.
        b.publisher.publish(cloud_of(points, 3))
        b.wait_for_status('input', lambda values, _: values['Refused since startup'] == '2')
        assert (tf.n_cleared, len(b.ground.messages)) == (1, 3)
        # The next transform counts.
        tf.known['base_link', 'tilted_lidar'] = np.eye(3)
        label = SEGMENTER.segment(xyz_of(points), (0.0, 0.0)).label
        assert b.segment(cloud_of(points, 3))[0].width == (label == Label.GROUND).sum()
        for level, n_listeners in (('sensor', 0), ('tf', 1)):
            assert not b.set('frame.level', level)
            wait_for(lambda n=n_listeners: b.probe.count_subscribers('/tf') == n, 'TF')


def test_clouds_wait_for_the_transform_of_their_stamp(monkeypatch, tf):
    """And keep their order: for a base that pitches, the newest transform so far is wrong."""
    monkeypatch.setattr(transforms, 'MAX_WAIT', 60.0)
    way, tf.newest = ('base_link', 'tilted_lidar'), 2.6
    tf.known[way] = tf.known['base_link', 'other_lidar'] = rotation(1.0, 0.5)
    points, turn = turned_street()
    depth = {f'qos_overrides.{ros.NAMESPACE}/points.subscription.depth': 5}
    with bench({**VALUES, 'frame.level': 'tf', **depth}) as b:
        messages = [cloud_of(points, 3, n) for n in range(2)]
        for message in messages:
            b.publisher.publish(message)
        wait_for(lambda: b.node._frames and len(b.node._frames._waiting) == 2, 'clouds that wait')
        assert not b.ground.messages
        # Not so behind those of another frame, which TF may not even connect.
        b.segment(to_message(points, stamp=(2, 6 * 10**8), frame='other_lidar'))
        tf.known[way], tf.newest = turn, 100
        for k, message in enumerate(messages, 1):
            check_levelled(points, message, (b.ground.wait(3)[k], b.obstacles.wait(3)[k]))


def test_place_of_the_sensor_by_tf(tf):
    """A room in the frame of a vehicle: which of its planes is the floor, the origin tells."""
    sensor = dataclasses.replace(VLP_16, n_columns=600, height=1.2)
    xyz = simulate_scan(ROOM, sensor, np.random.default_rng(0)).points[:, :3]
    points = ros.moved(street(len(xyz)), xyz + np.array([0.0, 0.0, 1.2]))
    with bench({'learning.mode': 'fixed', 'frame.sensor': 'lidar'}) as b:
        message = to_message(points, stamp=(3, 4), frame='base_footprint')
        b.publisher.publish(message)
        status = b.wait_for_status('input', lambda v, s: 'no transform' in s.message)
        assert "frame.sensor = 'lidar'" in status.message and 'base_footprint' in status.message
        tf.known['base_footprint', 'lidar'], tf.place = np.eye(3), (math.nan, 0.0, 1.2)
        b.publisher.publish(message)
        b.wait_for_status('input', lambda v, s: 'its translation is (nan' in s.message)
        tf.place = 0.0, 0.0, 1.2
        assert b.segment(message)[0].width > 0.05 * len(points)
        b.wait_for_status('model', lambda v, s: v['Taken from the scan'] == 'height')
        # Without it the height is not known, and nothing is ground.
        assert not b.set('frame.sensor', 'none')
        assert b.segment(message)[0].width == 0


def test_the_crop_box_is_in_the_base_of_tf(tf):
    points, turn = turned_street()
    tf.known['base_link', 'tilted_lidar'], tf.place = turn, (0.5, -0.3, 1.73)
    box = np.array([-9.0, 9.0, -5.0, 6.0, -0.5, 2.0])
    in_base = xyz_of(points).astype(np.float64) @ turn.T + tf.place
    inside = ((in_base > box[::2]) & (in_base < box[1::2])).all(axis=1)
    values = {**VALUES, 'frame.level': 'tf', 'input.crop_box': box.tolist()}
    message = cloud_of(points, 3)
    rows = ros.rows_of(message)
    with bench(values) as b:
        found = sorted(row for part in b.segment(message) for row in ros.rows_of(part))
    assert 200 < inside.sum() < 3000
    assert found == sorted(row for row, is_body in zip(rows, inside, strict=True) if not is_body)


@contextlib.contextmanager
def bench_with_imu():
    """A node that takes the tilt of an IMU, and a function that sends an orientation to it."""
    with bench({**VALUES, 'frame.level': 'imu'}) as b:
        publisher = b.probe.create_publisher(Imu, 'imu', ros.BEST_EFFORT)
        wait_for(lambda: publisher.get_subscription_count() == 1, 'subscription of imu')

        def say(matrix, stamp, frame='tilted_lidar', covariance=0.01):
            message = Imu(orientation=quaternion(matrix))
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
            message.header.frame_id = frame
            message.orientation_covariance[0] = covariance
            publisher.publish(message)  # which lies in the queue of the node then

        yield b, say


def test_tilt_by_an_imu(monkeypatch):
    points, turn = turned_street()
    with bench_with_imu() as (b, say):

        def check_refused(reason, seconds, nanosec=0):
            b.publisher.publish(cloud_of(points, seconds, nanosec))
            b.wait_for_status('input', lambda _, s: reason in s.message)

        check_refused(f'no message on {ros.NAMESPACE}/imu, for frame.level = imu', 2)
        # A cloud waits for the first orientation that is newer; the nearest in time holds.
        monkeypatch.setattr(transforms, 'MAX_WAIT', 60.0)
        message = cloud_of(points, 3, 10_000_000)
        b.publisher.publish(message)
        wait_for(lambda: len(b.node._frames._waiting) == 1, 'cloud that waits')
        say(np.eye(3), (3, 0))
        time.sleep(5 * transforms.REVIEW_PERIOD)
        assert len(b.node._frames._waiting) == 1
        for nanosec, matrix in ((9_000_000, turn), (12_000_000, np.eye(3))):
            say(matrix, (3, nanosec))
        check_levelled(points, message, (b.ground.wait(1)[0], b.obstacles.wait(1)[0]))
        # Refused: far from it in time, without an orientation, in a frame that is not known.
        monkeypatch.setattr(transforms, 'MAX_WAIT', 0.1)
        check_refused('is 0.058 s from its stamp: must be within 0.05 s', 3, 70_000_000)
        say(turn, (5, 0), covariance=-1.0)
        check_refused('orientation_covariance[0] is -1', 5)
        say(turn, (6, 0), frame='imu_link')
        check_refused('to that of /test_' if HAS_TF2 else 'needs tf2_ros (sudo apt install', 6)
        assert len(b.ground.messages) == 1
        assert not b.set('frame.level', 'sensor')
        wait_for(lambda: not b.probe.count_subscribers('imu'), 'end of the subscription')
        assert len(b.segment(cloud_of(points, 7))) == 2


def test_a_node_that_is_behind_takes_all_orientations_before_it_refuses(monkeypatch):
    points, turn = turned_street()
    message = cloud_of(points, 3)
    with bench_with_imu() as (b, say):
        # They lie in the queue while it does something else, and there is no time to wait.
        monkeypatch.setattr(transforms, 'MAX_WAIT', 0.0)
        is_busy, is_free = threading.Event(), threading.Event()
        b.node.executor.create_task(lambda: is_busy.set() or is_free.wait(ros.PATIENCE))
        assert is_busy.wait(ros.PATIENCE)
        b.publisher.publish(message)
        for k in range(20):
            say(np.eye(3), (2, 10_000_000 * k))
        say(turn, (3, 1))
        is_free.set()
        check_levelled(points, message, (b.ground.wait(1)[0], b.obstacles.wait(1)[0]))
        # They come late, the older ones first.
        now = [0.0]
        monkeypatch.setattr(transforms, 'time', types.SimpleNamespace(monotonic=lambda: now[0]))
        late = cloud_of(points, 5)
        b.publisher.publish(late)
        wait_for(lambda: b.node._frames._waiting, 'cloud that waits')
        now[0] = 0.9
        for k in range(10):
            say(np.eye(3), (4, 10_000_000 * k))
        wait_for(lambda: b.node._frames._orientations[-1][0] == 4_090_000_000, 'older ones')
        say(turn, (5, 1))
        check_levelled(points, late, (b.ground.wait(2)[1], b.obstacles.wait(2)[1]))


def test_tilt_by_an_imu_in_another_frame(tf):
    points, turn = turned_street()
    tf.known['imu_link', 'tilted_lidar'] = mount = rotation(-1.2, 0.7)
    message = cloud_of(points, 3)
    with bench_with_imu() as (b, say):
        say(turn @ mount.T, (3, 20_000_000), 'imu_link')
        check_levelled(points, message, b.segment(message))


@pytest.mark.skipif(not HAS_TF2, reason='tf2_ros is not installed (it has no wheel)')
def test_tilt_by_real_tf():
    """Between transforms that move, and a part that does not."""
    from tf2_ros import StaticTransformBroadcaster, TransformBroadcaster

    points, turn = turned_street()
    message = cloud_of(points, 3, 5 * 10**8)
    with bench({**VALUES, 'frame.level': 'tf'}) as b:

        def sent(kind, parent, child, matrix, seconds):
            known = TransformStamped(child_frame_id=child)
            known.header.frame_id, known.header.stamp.sec = parent, seconds
            known.transform.rotation = quaternion(matrix)
            kind.sendTransform(known)

        moving, static = TransformBroadcaster(b.probe), StaticTransformBroadcaster(b.probe)
        sent(static, 'base_link', 'mount', np.eye(3), 0)
        wait_for(lambda: moving.pub_tf.get_subscription_count() == 1, 'subscription of /tf')
        for seconds in range(1, 7):
            matrix = turn if seconds in (3, 4) else np.eye(3)
            sent(moving, 'mount', 'tilted_lidar', matrix, seconds)
        # Clouds are refused until it is there; no transform is taken but with a cloud.
        b.publish_until(message, lambda: b.ground.messages, 'ground by TF')
        check_levelled(points, message, (b.ground.messages[0], b.obstacles.wait(1)[0]))
