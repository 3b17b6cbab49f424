"""Tilt and place of the sensor at the stamp of a cloud: by TF, an IMU, or an earlier cloud."""

import importlib
import struct
import time
from bisect import bisect_left, insort
from collections import defaultdict, deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Quaternion
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu, PointCloud2
from std_msgs.msg import Header

from gp_ground_seg.core.errors import MissingDependencyError, PointCloudError
from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.parameters.config import NO_FRAME, Config
from gp_ground_seg.core.pipeline.points import angles_of
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.data.point_cloud2 import stamp_of
from gp_ground_seg.ros.input import STEADY_CLOCK

KEPT_JUMP = 1.0  # after a longer jump back in time, transforms are forgotten [s]
MAX_WAIT = 0.2  # time that a cloud waits for the transforms of its stamp [s]
LONGEST_WAIT = 1.0  # the same, where it would be refused: the node may be behind [s]
REVIEW_PERIOD = 0.01  # time between two checks of whether they have come [s]
IMU_TOLERANCE = 0.05  # longest time between a cloud and its orientation [s]
KEPT_TIME = 10 * 10**9  # time that messages are kept, as in a buffer of TF [ns]
CDR_HEADER = 4  # bytes before the content of a serialised message
FIRST_STAMP = CDR_HEADER + 4  # that of a message of TF, behind the number of transforms [bytes]
TRANSFORM = 7 * 8  # translation and quaternion [bytes]
DEPTH = 1000  # messages kept: those of 1 s at 1 kHz
BEST_EFFORT = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
INSTALL_TF2 = 'sudo apt install ros-jazzy-tf2-ros-py'


def find_module(name: str) -> Any:
    """Return a module of ROS that is not a dependency, None if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def check_tf2(config: Config) -> None:
    """Raise a GroundSegError if TF is asked for, and is not installed."""
    frame = config.frame
    if is_tf_used(config) and find_module('tf2_ros') is None:
        asked = 'level = tf' if frame.level == 'tf' else f'sensor = {frame.sensor}'
        raise MissingDependencyError(
            f'frame.{asked}: needs tf2_ros, which cannot be imported: {INSTALL_TF2}'
        )


def rotation_of(rotation: Quaternion) -> FloatArray:
    """Matrix (3, 3) of a quaternion; raise a PointCloudError if its length is not 1."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    square = x * x + y * y + z * z + w * w
    if not abs(square - 1.0) < 1e-3:
        given = f'({x:g}, {y:g}, {z:g}, {w:g}) of length {square**0.5:g}'
        raise PointCloudError(f'quaternion {given}: must be 1')
    return np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix())


def _translation_of(transform: Any, way: str) -> tuple[float, float, float]:
    """Return that of a geometry_msgs/Transform; raise a PointCloudError if it is not finite."""
    place = transform.translation
    translation = place.x, place.y, place.z
    if not np.isfinite(translation).all():
        raise PointCloudError(f'transform {way}: its translation is {translation}')
    return translation


def is_tf_used(config: Config) -> bool:
    """Return whether tilt or place of the sensor needs TF."""
    return config.frame.level == 'tf' or config.frame.sensor != NO_FRAME


class CloudFrames(NamedTuple):
    """Tilt, place and base of the sensor by TF or IMU; None where the parameters ask for none."""

    tilt: tuple[float, float] | None = None  # roll and pitch of the sensor [rad]
    origin: tuple[float, float, float] | None = None  # place of the sensor in it [m]
    # rotation (3, 3) and translation (3,) [m] into ``frame.base``
    base: tuple[FloatArray, FloatArray] | None = None
    age: float | None = None  # longest time from the cloud to a transform or orientation [s]
    waited: float = 0.0  # how long the cloud was held [s]


Found = CloudFrames | Exception
"""What is known of a cloud, or why it is refused."""
NO_FRAMES = CloudFrames()


class Unattended(CallbackGroup):  # type: ignore[misc]
    """Keeps subscriptions from the executor, which spends 0.3 ms on a message, and their events.

    Data that nobody takes would wake it all the time.
    """

    def can_execute(self, _entity: object) -> bool:
        """Return whether the executor may wait for an entity: never."""
        return False


class Kept(list[tuple[int, bytes]]):
    """Messages of `KEPT_TIME`, as bytes behind their stamps [ns]: most are never read."""

    def add(self, stamp: int, message: bytes) -> None:
        """Keep a message, and forget old ones."""
        insort(self, (stamp, message))
        if stamp - self[0][0] > 2 * KEPT_TIME:
            del self[: bisect_left(self, (stamp - KEPT_TIME, b''))]

    def beside(self, stamp: int) -> slice:
        """Return where the messages next to `stamp` are, or all if it is 0."""
        index = bisect_left(self, (stamp, b''))
        return slice(max(index - 1, 0), index + 1) if stamp else slice(None)

    def read(self, stamp: int) -> list[bytes]:
        """Return those messages, each but once."""
        beside = self.beside(stamp)
        found, self[beside] = self[beside], [(own, b'') for own, _ in self[beside]]
        return [message for _, message in found if message]


def stamp_in(message: bytes, begin: int) -> int:
    """Return the stamp that begins in a serialised message at byte `begin` [ns]."""
    order = '<' if message[1] & 1 else '>'
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', message, begin)
    return int(10**9 * seconds + nanoseconds)


def names_in(message: bytes) -> bytes:
    """Return the frames that a serialised message of TF is about.

    Nothing if its transforms have not all one stamp, or it is not in plain little-endian CDR.
    """
    names, begin = b'', FIRST_STAMP
    (count,) = struct.unpack_from('<I', message, CDR_HEADER)
    for _ in range(count if message[1] == 1 else 0):
        if message[begin : begin + 8] != message[FIRST_STAMP : FIRST_STAMP + 8]:
            return b''
        begin += 8
        for _parent_and_child in range(2):
            (length,) = struct.unpack_from('<I', message, begin)
            names += message[begin : begin + 4 + length]
            begin += 4 + length + -length % 4
        begin += (CDR_HEADER - begin) % 8 + TRANSFORM  # numbers are aligned to 8 bytes
    return names


class FrameListener:
    """Listens to TF and to an IMU, as `config` asks.

    `hold` takes clouds and passes them to `use`, those of a frame in their order: each as soon as
    transform and orientation at its stamp are known, or after `MAX_WAIT`. One that would be
    refused then waits on, up to `LONGEST_WAIT`: the node may be behind, or their sender. What TF
    and IMU have sent is taken when a cloud comes or waits, and read only next to the stamp of a
    cloud: to read a transform takes ten times as long as to take it.
    """

    def __init__(self, node: Node, config: Config, use: Callable[..., None]) -> None:
        self.config = config
        self._node, self._use = node, use
        self._orientations = Kept()
        self._transforms: defaultdict[bytes, Kept] = defaultdict(Kept)  # by the names in them
        self._imu = node.resolve_topic_name('imu') if config.frame.level == 'imu' else ''
        self._buffer: Any = None
        self._not_yet: Any = ()  # what TF raises
        sources: list[tuple[Any, str, Callable[[bytes], None], QoSProfile]] = []
        if self._imu:  # takes from any publisher
            keep = self._orientations.add
            sources += [(Imu, 'imu', lambda m: keep(stamp_in(m, CDR_HEADER), m), BEST_EFFORT)]
        if (tf2 := find_module('tf2_ros')) is not None:
            self._not_yet, self._too_late = tf2.TransformException, tf2.ExtrapolationException
            # Without the node: given one, the buffer clears itself at jumps of the node's clock,
            # and in some releases raises an error there that ends the executor. See `time_jumped`.
            self._buffer = tf2.Buffer()
            self._kind = find_module('tf2_msgs.msg').TFMessage
            read_static = partial(self._read, is_static=True)
            sources += [(self._kind, '/tf', self._take_tf, RELIABLE)]
            sources += [(self._kind, '/tf_static', read_static, LATCHED)]
        group = Unattended()
        self._subscriptions = [
            node.create_subscription(*source, callback_group=group) for source in sources
        ]
        self._waiting: deque[tuple[float, Header, Callable[[Found], None]]] = deque()
        self._timer = node.create_timer(REVIEW_PERIOD, self._review, clock=STEADY_CLOCK)
        self._timer.cancel()

    def hold(self, cloud: PointCloud2, arrival: float, n_lost: int) -> None:
        """Keep a cloud until its transform and orientation are known."""
        use = partial(self._use, cloud, arrival, n_lost)
        self._waiting.append((time.monotonic(), cloud.header, use))
        self._review()

    def _take_all(self) -> None:
        """Take all that TF and IMU have sent."""
        for source in self._subscriptions:
            with source.handle:
                while (taken := source.handle.take_message(source.msg_type, True)) is not None:
                    source.callback(taken[0])

    def _take_tf(self, message: bytes) -> None:
        if names := names_in(message):
            self._transforms[names].add(stamp_in(message, FIRST_STAMP), message)
        else:
            self._read(message)

    def _read(self, message: bytes, is_static: bool = False) -> None:
        """Give transforms to the buffer of TF."""
        keep = self._buffer.set_transform_static if is_static else self._buffer.set_transform
        for transform in deserialize_message(message, self._kind).transforms:
            keep(transform, 'default_authority')

    def _review(self) -> None:
        self._take_all()
        held: set[str] = set()  # frames of clouds that wait on
        for since, header, use in [*self._waiting]:
            waited = time.monotonic() - since
            if header.frame_id in held or not (found := self._find(header, waited)):
                held.add(header.frame_id)
            else:
                self._waiting.remove((since, header, use))
                use(found)
        (self._timer.reset if held else self._timer.cancel)()

    def _find(self, header: Header, waited: float) -> Found | None:
        """Return the frames at the stamp of a cloud that has `waited` [s]; None to wait on.

        If TF does not reach the stamp, its newest transform is used.
        """
        is_early, newest = waited < MAX_WAIT, self._orientations[-1:]
        if is_early and self._imu and not (newest and newest[0][0] >= stamp_of(header)):
            return None
        try:
            return self._frames_at(header, is_exact=is_early)._replace(waited=waited)
        except self._not_yet:
            return None
        except (PointCloudError, ValueError) as error:  # the cloud is refused with the reason
            return None if waited < LONGEST_WAIT else error

    def _frames_at(self, header: Header, is_exact: bool) -> CloudFrames:
        tilt, origin, base, ages = None, None, None, [0]
        frame_id, frame, stamp = header.frame_id, self.config.frame, stamp_of(header)

        def transform(target: str, source: str, way: str) -> Any:
            found = self._look_up(target, source, stamp, way, is_exact)
            ages.append(abs(stamp - stamp_of(found.header)))
            return found.transform

        if frame.level == 'tf':
            way = f'from its frame {frame_id!r} to frame.base = {frame.base!r}'
            found = transform(frame.base, frame_id, way)
            base = rotation_of(found.rotation), np.array(_translation_of(found, way))
            tilt = angles_of(base[0][2])
        elif self._imu:
            message, off = self._orientation_at(stamp)
            ages.append(off)
            turn, imu_frame = rotation_of(message.orientation), message.header.frame_id
            if imu_frame != frame_id:
                way = f'from its frame {frame_id!r} to that of {self._imu}, {imu_frame!r}'
                turn = turn @ rotation_of(transform(imu_frame, frame_id, way).rotation)
            tilt = angles_of(turn[2])
        if frame.sensor != NO_FRAME:
            way = f'from frame.sensor = {frame.sensor!r} to its frame {frame_id!r}'
            origin = _translation_of(transform(frame_id, frame.sensor, way), way)
        return CloudFrames(tilt, origin, base, 1e-9 * max(ages))

    def _orientation_at(self, stamp: int) -> tuple[Imu, int]:
        """Return the orientation nearest to the `stamp` of a cloud, and how far it is off [ns].

        Raises a PointCloudError without one that is near.
        """
        beside = self._orientations[self._orientations.beside(stamp)]
        if not beside:
            raise PointCloudError(f'no message on {self._imu}, for frame.level = imu')
        off, message = min((abs(own - stamp), message) for own, message in beside)
        if 1e-9 * off > IMU_TOLERANCE:
            raise PointCloudError(
                f'the nearest orientation on {self._imu} is {1e-9 * off:.3g} s from its stamp: '
                f'must be within {IMU_TOLERANCE:g} s'
            )
        imu = deserialize_message(message, Imu)
        if imu.orientation_covariance[0] == -1.0:
            raise PointCloudError(
                f'{self._imu} has no orientation (orientation_covariance[0] is -1): remap imu to '
                'the output of a filter, such as imu_filter_madgwick'
            )
        return imu, off

    def _look_up(self, target: str, source: str, stamp: int, way: str, is_exact: bool) -> Any:
        if self._buffer is None:
            raise PointCloudError(f'transform {way}: needs tf2_ros ({INSTALL_TF2})')
        # What TF interpolates between; for 0, its newest, any may be needed.
        for names, kept in [*self._transforms.items()]:
            for message in kept.read(stamp):
                self._read(message)
            if stamp - kept[-1][0] > 2 * KEPT_TIME:  # they come no more, and the last is read
                del self._transforms[names]
        try:
            return self._buffer.lookup_transform(target, source, Time(nanoseconds=stamp))
        except self._not_yet as error:
            if is_exact:
                raise
            if isinstance(error, self._too_late) and stamp:
                # The newest: a sensor is fixed to its vehicle.
                return self._look_up(target, source, 0, way, is_exact)
            raise PointCloudError(f'no transform {way}: {str(error).strip()}') from error

    def time_jumped(self, seconds: float) -> None:
        """Forget all after a long jump back, also what was not taken yet."""
        self._take_all()
        if seconds > KEPT_JUMP:
            self._orientations.clear()
            self._transforms.clear()
            if self._buffer is not None:
                self._buffer.clear()

    def close(self) -> None:
        """Stop listening; clouds that wait are dropped."""
        self._waiting.clear()
        self._node.destroy_timer(self._timer)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)


class KeptPose:
    """Pose of the last cloud that showed the ground well, for later clouds in the same frame."""

    _frame = ''
    _pose: SensorPose | None = None
    _is_in_use = False

    def fallback(self, frame: str) -> SensorPose | None:
        """Return the pose for a cloud in `frame`, or None; that of another frame is forgotten."""
        if frame != self._frame:
            self._frame, self._pose, self._is_in_use = frame, None, False
        return self._pose

    def note(self, pose: SensorPose) -> bool:
        """Take the pose of a cloud; return whether it is the first to have the kept one."""
        begins = pose.is_fallback and not self._is_in_use
        self._is_in_use = pose.is_fallback
        if pose.is_well_seen:
            self._pose = pose
        return begins
