"""Tilt and place of the sensor at the stamp of a cloud: by TF, an IMU, or an earlier cloud."""

from __future__ import annotations

import importlib
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Quaternion
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import Imu, PointCloud2
from std_msgs.msg import Header

from gp_ground_seg.core.errors import MissingDependencyError, PointCloudError
from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.parameters.config import NO_FRAME, Config
from gp_ground_seg.core.pipeline.points import angles_of
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.ros.input import STEADY_CLOCK, OnCloud, seconds_of

KEPT_JUMP = 1.0  # jump back up to which transforms are kept: a late stamp, no other run [s]
MAX_WAIT = 0.2  # time that a cloud waits for the transforms of its stamp [s]
REVIEW_PERIOD = 0.005  # time between two looks at whether they have come [s]
IMU_TOLERANCE = 0.05  # longest time between a cloud and its orientation [s]
IMU_DEPTH = 400  # messages kept: of the wait and of the previous cloud, at 1 kHz
INSTALL_TF2 = 'sudo apt install ros-jazzy-tf2-ros-py'


def find_tf2() -> Any:
    """Return the module tf2_ros, None if it is not installed."""
    try:
        return importlib.import_module('tf2_ros')
    except ImportError:
        return None


def check_tf2(config: Config) -> None:
    """Raise a MissingDependencyError if `config` asks for TF and tf2_ros is not installed."""
    if not is_tf_used(config) or find_tf2() is not None:
        return
    asked, instead = 'frame.level = tf', 'frame.level = sensor with sensor.roll and sensor.pitch'
    if config.frame.sensor != NO_FRAME:
        asked = f'frame.sensor = {config.frame.sensor}'
        instead = 'frame.sensor = none with sensor.origin_x, origin_y and origin_z'
    raise MissingDependencyError(
        f'{asked}: needs tf2_ros, which cannot be imported: {INSTALL_TF2}, or use {instead}'
    )


def rotation_of(rotation: Quaternion) -> FloatArray:
    """Matrix (3, 3) of a quaternion; raise a PointCloudError if its length is not 1."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    square = x * x + y * y + z * z + w * w
    if not abs(square - 1.0) < 1e-3:
        given = f'({x:g}, {y:g}, {z:g}, {w:g}) of length {square**0.5:g}'
        raise PointCloudError(f'quaternion {given}: must be 1')
    matrix: FloatArray = np.array(
        [
            [square - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), square - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), square - 2.0 * (x * x + y * y)],
        ]
    )
    matrix /= square
    return matrix


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


def is_listening(config: Config) -> bool:
    """Return whether a cloud needs a `FrameListener`."""
    return config.frame.level == 'imu' or is_tf_used(config)


class CloudFrames(NamedTuple):
    """What TF or an IMU say of the frame of a cloud; None for what the parameters do not ask."""

    tilt: tuple[float, float] | None = None  # roll and pitch of the sensor [rad]
    origin: tuple[float, float, float] | None = None  # place of the sensor in it [m]
    # rotation (3, 3) and translation (3,) [m] into ``frame.base``
    base: tuple[FloatArray, FloatArray] | None = None


class ImuListener:
    """Listens to ``imu`` in the executor of `node`."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._messages: deque[Imu] = deque(maxlen=IMU_DEPTH)
        # Best effort, which takes from any publisher.
        profile = QoSProfile(depth=IMU_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscription = node.create_subscription(Imu, 'imu', self._take, profile)
        self.topic: str = self._subscription.topic_name

    def _take(self, message: Imu) -> None:
        self._messages.append(message)

    def frame_at(self, header: Header) -> str | None:
        """Return the frame of the IMU; None if it has sent nothing as new as a cloud."""
        newest = self._messages[-1].header if self._messages else None
        if newest is None or seconds_of(newest.stamp) < seconds_of(header.stamp):
            return None
        return str(newest.frame_id)

    def at(self, header: Header) -> Imu:
        """Return the message nearest in time to a cloud; raise a PointCloudError without one."""
        stamp = seconds_of(header.stamp)
        off = [abs(seconds_of(message.header.stamp) - stamp) for message in self._messages]
        if not off:
            raise PointCloudError(f'no message on {self.topic}, for frame.level = imu')
        if min(off) > IMU_TOLERANCE:
            raise PointCloudError(
                f'the nearest orientation on {self.topic} is {min(off):.3g} s from its stamp: '
                f'must be within {IMU_TOLERANCE:g} s'
            )
        found = self._messages[off.index(min(off))]
        if found.orientation_covariance[0] == -1.0:
            raise PointCloudError(
                f'{self.topic} has no orientation (orientation_covariance[0] is -1): remap imu to '
                'the output of a filter, such as imu_filter_madgwick'
            )
        return found

    def close(self) -> None:
        """Stop listening."""
        self._node.destroy_subscription(self._subscription)


class FrameListener:
    """Listens to TF and to an IMU in the executor of `node`, for what `config` asks.

    Clouds come to `hold`, which passes each on to `use`, in their order, as soon as all that it
    needs is known at its stamp, or after `MAX_WAIT`. TF and IMU come to the same executor: a
    callback cannot wait for them.
    """

    def __init__(self, node: Node, config: Config, use: OnCloud) -> None:
        self.config = config
        self._imu = ImuListener(node) if config.frame.level == 'imu' else None
        self._tf2_ros = find_tf2()
        if self._tf2_ros is not None:
            # Without the node: given one, the buffer clears itself at jumps of the node's clock,
            # and in some releases raises an error there that ends the executor. See `time_jumped`.
            self._buffer = self._tf2_ros.Buffer()
            self._listener = self._tf2_ros.TransformListener(self._buffer, node, spin_thread=False)
        self._waiting: deque[tuple[float, Header, Callable[[], None]]] = deque()
        self._node, self._use = node, use
        self._timer = node.create_timer(REVIEW_PERIOD, self._review, clock=STEADY_CLOCK)
        self._timer.cancel()

    def hold(self, cloud: PointCloud2, arrival: float, n_lost: int) -> None:
        """Keep a cloud until all that it needs is known."""
        use = partial(self._use, cloud, arrival, n_lost)
        self._waiting.append((time.monotonic() + MAX_WAIT, cloud.header, use))
        self._review()

    def _review(self) -> None:
        while self._waiting:
            deadline, header, use = self._waiting[0]
            if time.monotonic() < deadline and not self._is_known(header):
                self._timer.reset()
                return
            self._waiting.popleft()
            use()
        self._timer.cancel()

    def _is_known(self, header: Header) -> bool:
        wanted = {self.config.frame.sensor}
        if self.config.frame.level == 'tf':
            wanted.add(self.config.frame.base)
        if self._imu is not None:
            frame = self._imu.frame_at(header)
            if frame is None:
                return False
            wanted.add(frame)
        if self._tf2_ros is None:
            return True
        try:
            for frame in wanted - {NO_FRAME, header.frame_id}:
                self._exact(frame, header.frame_id, header)
        except self._tf2_ros.TransformException:
            return False
        except ValueError:
            return True  # no such time: the cloud is refused with the reason
        return True

    def look_up(self, header: Header) -> CloudFrames:
        """Return what is known of the frame of a cloud.

        Tilt and place of the sensor are those of the stamp, or the newest if TF does not reach it.
        Raises a PointCloudError if TF does not have what is asked for.
        """
        tilt, origin, base = None, None, None
        frame_id, frame = header.frame_id, self.config.frame
        if frame.level == 'tf':
            way = f'from its frame {frame_id!r} to frame.base = {frame.base!r}'
            found = self._newest(frame.base, frame_id, header, way)
            base = rotation_of(found.rotation), np.array(_translation_of(found, way))
            tilt = angles_of(base[0][2])
        elif self._imu is not None:
            tilt = angles_of(self._turn_by_imu(self._imu, header)[2])
        if frame.sensor != NO_FRAME:
            way = f'from frame.sensor = {frame.sensor!r} to its frame {frame_id!r}'
            found = self._newest(frame_id, frame.sensor, header, way)
            origin = _translation_of(found, way)
        return CloudFrames(tilt, origin, base)

    def _turn_by_imu(self, listener: ImuListener, header: Header) -> FloatArray:
        """Return the rotation (3, 3) of a cloud into a level frame, by way of that of the IMU."""
        found = listener.at(header)
        turn, frame = rotation_of(found.orientation), found.header.frame_id
        if frame == header.frame_id:
            return turn
        way = f'from its frame {header.frame_id!r} to that of {listener.topic}, {frame!r}'
        if self._tf2_ros is None:
            raise PointCloudError(f'transform {way}: needs tf2_ros ({INSTALL_TF2})')
        return turn @ rotation_of(self._newest(frame, header.frame_id, header, way).rotation)

    def _exact(self, target: str, source: str, header: Header) -> Any:
        stamp = Time.from_msg(header.stamp)
        return self._buffer.lookup_transform(target, source, stamp).transform

    def _newest(self, target: str, source: str, header: Header, way: str) -> Any:
        try:
            try:
                return self._exact(target, source, header)
            except self._tf2_ros.ExtrapolationException:
                # The newest: a sensor is fixed to its vehicle.
                return self._buffer.lookup_transform(target, source, Time()).transform
        except self._tf2_ros.TransformException as error:
            raise PointCloudError(f'no transform {way}: {error}') from error

    def time_jumped(self, seconds: float) -> None:
        """Forget all transforms after a long jump back."""
        if seconds > KEPT_JUMP and self._tf2_ros is not None:
            self._buffer.clear()

    def close(self) -> None:
        """Stop listening; clouds that wait are dropped."""
        self._waiting.clear()
        self._node.destroy_timer(self._timer)
        if self._tf2_ros is not None:
            self._listener.unregister()
        if self._imu is not None:
            self._imu.close()


class KeptPose:
    """Pose of the newest cloud of one frame that showed the ground well, until it is forgotten."""

    def __init__(self) -> None:
        self._frame = ''
        self.forget()

    def forget(self) -> None:
        """Have no pose, as after the start."""
        self._pose: SensorPose | None = None
        self._is_in_use = False

    def fallback(self, frame: str) -> SensorPose | None:
        """Return the pose for a cloud in `frame`, or None; that of another frame is forgotten."""
        if frame != self._frame:
            self._frame = frame
            self.forget()
        return self._pose

    def note(self, pose: SensorPose) -> bool:
        """Take the pose used for that cloud; return whether use of the one kept begins with it."""
        begins = pose.is_fallback and not self._is_in_use
        self._is_in_use = pose.is_fallback
        if pose.is_well_seen:
            self._pose = pose
        return begins
