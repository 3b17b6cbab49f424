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

KEPT_JUMP = 1.0  # after a longer jump back in time, transforms are forgotten [s]
MAX_WAIT = 0.2  # time that a cloud waits for the transforms of its stamp [s]
REVIEW_PERIOD = 0.005  # time between two checks of whether they have come [s]
IMU_TOLERANCE = 0.05  # longest time between a cloud and its orientation [s]
IMU_DEPTH = 400  # messages kept: those of 0.4 s at 1 kHz
INSTALL_TF2 = 'sudo apt install ros-jazzy-tf2-ros-py'


def find_module(name: str) -> Any:
    """Return a module of ROS that is not a dependency, None if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def check_tf2(config: Config) -> None:
    """Raise a MissingDependencyError if `config` asks for TF and tf2_ros is not installed."""
    if is_tf_used(config) and find_module('tf2_ros') is None:
        frame = config.frame
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


class CloudFrames(NamedTuple):
    """Tilt, place and base of the sensor by TF or IMU; None where the parameters ask for none."""

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

    def reaches(self, header: Header) -> bool:
        """Return whether it has sent something as new as a cloud."""
        newest = [seconds_of(message.header.stamp) for message in self._messages][-1:]
        return bool(newest) and newest[0] >= seconds_of(header.stamp)

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
    """Listens to TF and to an IMU, as `config` asks, in the executor of `node`.

    `hold` takes clouds and passes them to `use` in their order: each as soon as transform and
    orientation at its stamp are known, or after `MAX_WAIT`. It does not block: the messages of TF
    and IMU come to the same executor.
    """

    def __init__(self, node: Node, config: Config, use: OnCloud) -> None:
        self.config = config
        self._imu = ImuListener(node) if config.frame.level == 'imu' else None
        self._tf2_ros = find_module('tf2_ros')
        self._not_yet: Any = ()  # what TF raises
        self._too_late: Any = ()
        if self._tf2_ros is not None:
            self._not_yet = self._tf2_ros.TransformException
            self._too_late = self._tf2_ros.ExtrapolationException
            # Without the node: given one, the buffer clears itself at jumps of the node's clock,
            # and in some releases raises an error there that ends the executor. See `time_jumped`.
            self._buffer = self._tf2_ros.Buffer()
            self._listener = self._tf2_ros.TransformListener(self._buffer, node, spin_thread=False)
        self._waiting: deque[tuple[float, Header, Callable[[], None]]] = deque()
        self._node, self._use = node, use
        self._timer = node.create_timer(REVIEW_PERIOD, self._review, clock=STEADY_CLOCK)
        self._timer.cancel()

    def hold(self, cloud: PointCloud2, arrival: float, n_lost: int) -> None:
        """Keep a cloud until its transform and orientation are known."""
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
        """Return whether `look_up` need not wait: all is known at the stamp, or it raises."""
        if self._imu is not None and not self._imu.reaches(header):
            return False
        try:
            self.look_up(header, is_exact=True)
        except self._not_yet:
            return False
        except (PointCloudError, ValueError):
            return True  # the cloud is refused with the reason
        return True

    def look_up(self, header: Header, is_exact: bool = False) -> CloudFrames:
        """Return tilt and place of the sensor at the stamp of a cloud, as the parameters ask.

        If TF does not reach the stamp, its newest transform is used, unless it `is_exact`. Raises
        a PointCloudError if a transform or an orientation is missing.
        """
        tilt, origin, base = None, None, None
        transform = self._exact if is_exact else self._newest
        frame_id, frame = header.frame_id, self.config.frame
        if frame.level == 'tf':
            way = f'from its frame {frame_id!r} to frame.base = {frame.base!r}'
            found = transform(frame.base, frame_id, header, way)
            base = rotation_of(found.rotation), np.array(_translation_of(found, way))
            tilt = angles_of(base[0][2])
        elif self._imu is not None:
            message = self._imu.at(header)
            turn, imu_frame = rotation_of(message.orientation), message.header.frame_id
            if imu_frame != frame_id:
                way = f'from its frame {frame_id!r} to that of {self._imu.topic}, {imu_frame!r}'
                turn = turn @ rotation_of(transform(imu_frame, frame_id, header, way).rotation)
            tilt = angles_of(turn[2])
        if frame.sensor != NO_FRAME:
            way = f'from frame.sensor = {frame.sensor!r} to its frame {frame_id!r}'
            origin = _translation_of(transform(frame_id, frame.sensor, header, way), way)
        return CloudFrames(tilt, origin, base)

    def _exact(self, target: str, source: str, header: Header, way: str) -> Any:
        if self._tf2_ros is None:
            raise PointCloudError(f'transform {way}: needs tf2_ros ({INSTALL_TF2})')
        stamp = Time.from_msg(header.stamp)
        return self._buffer.lookup_transform(target, source, stamp).transform

    def _newest(self, target: str, source: str, header: Header, way: str) -> Any:
        try:
            try:
                return self._exact(target, source, header, way)
            except self._too_late:
                # The newest: a sensor is fixed to its vehicle.
                return self._buffer.lookup_transform(target, source, Time()).transform
        except self._not_yet as error:
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
    """Pose of the last cloud that showed the ground well, for later clouds in the same frame."""

    def __init__(self) -> None:
        self._frame = ''
        self.forget()

    def forget(self) -> None:
        """Keep no pose, as after the start."""
        self._pose: SensorPose | None = None
        self._is_in_use = False

    def fallback(self, frame: str) -> SensorPose | None:
        """Return the pose for a cloud in `frame`, or None; that of another frame is forgotten."""
        if frame != self._frame:
            self._frame = frame
            self.forget()
        return self._pose

    def note(self, pose: SensorPose) -> bool:
        """Take the pose of a cloud; return whether it is the first to have the kept one."""
        begins = pose.is_fallback and not self._is_in_use
        self._is_in_use = pose.is_fallback
        if pose.is_well_seen:
            self._pose = pose
        return begins
