"""The input: profiles of clouds, time jumps, tilt and place of the sensor by TF."""

from __future__ import annotations

import functools
import importlib
from array import array
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import Quaternion
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.time import Time
from std_msgs.msg import Header

from gp_ground_seg.core.errors import ConfigError, MissingDependencyError, PointCloudError
from gp_ground_seg.core.parameters.config import NO_FRAME, FrameConfig
from gp_ground_seg.core.pipeline.tilt import angles_of
from gp_ground_seg.data import point_cloud2

OUTPUT_DEPTH = 20  # clouds kept: Fast DDS may send a lost fragment again after 0.7 s only
MAX_DEPTH = 10_000
QOS_OVERRIDES = 'qos_overrides.'
JUMP_TOLERANCE = 0.5  # stamps of several sensors on one topic may be that much out of order [s]
TF_JUMP = 1.0  # jump back up to which transforms are kept: a late stamp, no other run [s]
STEADY_CLOCK = Clock(clock_type=ClockType.STEADY_TIME)  # the clock of a node may stand or jump
THROTTLED = {'throttle_duration_sec': 5.0, 'throttle_time_source_type': STEADY_CLOCK}
"""Options of messages that may come with every cloud."""


def message_data(values: npt.NDArray[Any]) -> array[int]:
    """Return the bytes of an array as the one type that rclpy takes without a look at each."""
    data = array('B')
    data.frombytes(np.ascontiguousarray(values).data.cast('B') if values.size else b'')
    return data


select_points = functools.partial(point_cloud2.select_points, as_data=message_data)


def check_overrides(given: Mapping[str, object]) -> None:
    """Raise a ConfigError for a depth in ``qos_overrides`` at which rcl fails without a reason."""
    for name, value in given.items():
        is_depth = name.startswith(QOS_OVERRIDES) and name.endswith('.depth')
        if is_depth and isinstance(value, int) and not 1 <= value <= MAX_DEPTH:
            raise ConfigError(f'{name} = {value}: must be an integer in [1, {MAX_DEPTH}]')


def cloud_profile(depth: int = OUTPUT_DEPTH) -> QoSProfile:
    """Return the default of a cloud topic: reliable, volatile, the newest `depth` clouds."""
    return QoSProfile(depth=depth)


def in_words(profile: QoSProfile) -> str:
    """Return `profile` as in ``reliable, keep_last 5, volatile``."""
    reliability, history, durability = profile.reliability, profile.history, profile.durability
    return f'{reliability.name}, {history.name} {profile.depth}, {durability.name}'.lower()


class StampWatch:
    """Detects from the stamps of clouds that time has jumped back."""

    _newest: float | None = None

    def reset(self) -> None:
        """Forget the newest stamp."""
        self._newest = None

    def note(self, stamp: float) -> float:
        """Return how far `stamp` lies before the newest one; 0 if that is no jump [s]."""
        newest = self._newest if self._newest is not None else stamp
        jump = newest - stamp if newest - stamp > JUMP_TOLERANCE else 0.0
        self._newest = stamp if jump else max(newest, stamp)
        return jump


class TimeJumps:
    """Calls `on_jump` with how far [s] stamps of clouds, or the clock of `node`, jump back."""

    def __init__(self, node: Node, on_jump: Callable[[float], None]) -> None:
        self._node = node
        self._on_jump = on_jump
        self._stamps = StampWatch()
        threshold = JumpThreshold(
            min_forward=None, min_backward=Duration(seconds=-JUMP_TOLERANCE), on_clock_change=False
        )
        # The callback lives as long as its handle.
        self._handle = node.get_clock().create_jump_callback(
            threshold, post_callback=self._clock_jumped
        )

    def note(self, stamp: float) -> None:
        """Take the `stamp` of a cloud [s]."""
        if jump := self._stamps.note(stamp):
            self._jumped(jump)

    def _clock_jumped(self, jump: TimeJump) -> None:
        # The stamps that follow are part of the same jump.
        self._stamps.reset()
        self._jumped(-1e-9 * jump.delta.nanoseconds)

    def _jumped(self, seconds: float) -> None:
        self._on_jump(seconds)
        self._node.get_logger().info(
            f'time jumped back by {seconds:.1f} s: what earlier clouds taught is forgotten',
            **THROTTLED,
        )


def require_tf2(frame: FrameConfig) -> Any:
    """Return the module tf2_ros; raise a MissingDependencyError if it is not installed."""
    asked, instead = 'frame.level = tf', 'frame.level = sensor with sensor.roll and sensor.pitch'
    if frame.level != 'tf':
        asked = f'frame.sensor = {frame.sensor}'
        instead = 'frame.sensor = none with sensor.origin_x, origin_y and origin_z'
    try:
        return importlib.import_module('tf2_ros')
    except ImportError as error:
        raise MissingDependencyError(
            f'{asked}: needs tf2_ros, which cannot be imported ({error}): sudo apt '
            f'install ros-jazzy-tf2-ros-py, or use {instead}'
        ) from error


def tilt_of(rotation: Quaternion) -> tuple[float, float]:
    """Return roll and pitch [rad] of a sensor frame that `rotation` turns into a level one."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    square = x * x + y * y + z * z + w * w
    if not abs(square - 1.0) < 1e-3:
        given = f'({x:g}, {y:g}, {z:g}, {w:g}) of length {square**0.5:g}'
        raise PointCloudError(f'quaternion {given}: must be 1')
    # Third row of its matrix: the level frame's z axis in the sensor frame.
    up = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), square - 2.0 * (x * x + y * y)])
    return angles_of(up / np.linalg.norm(up))


def is_tf_used(frame: FrameConfig) -> bool:
    """Return whether the tilt or the place of the sensor comes from TF."""
    return frame.level == 'tf' or frame.sensor != NO_FRAME


class TfListener:
    """Listens to TF in the executor of `node`, for what `frame` asks."""

    def __init__(self, node: Node, frame: FrameConfig) -> None:
        self._tf2_ros = require_tf2(frame)
        # Without the node: given one, the buffer clears itself at jumps of the node's clock,
        # and in some releases raises an error there that ends the executor. See `time_jumped`.
        self._buffer = self._tf2_ros.Buffer()
        self._listener = self._tf2_ros.TransformListener(self._buffer, node, spin_thread=False)

    def look_up(
        self, header: Header, frame: FrameConfig
    ) -> tuple[tuple[float, float] | None, tuple[float, float, float] | None]:
        """Return tilt [rad] and place [m] of the sensor in a cloud; None for what is not asked.

        Raises a PointCloudError if TF does not have them.
        """
        tilt, origin, own = None, None, header.frame_id
        if frame.level == 'tf':
            way = f'from its frame {own!r} to frame.base = {frame.base!r}'
            tilt = tilt_of(self._transform(frame.base, own, header, way).rotation)
        if frame.sensor != NO_FRAME:
            way = f'from frame.sensor = {frame.sensor!r} to its frame {own!r}'
            place = self._transform(own, frame.sensor, header, way).translation
            origin = place.x, place.y, place.z
            if not np.isfinite(origin).all():
                raise PointCloudError(f'transform {way}: its translation is {origin}')
        return tilt, origin

    def _transform(self, target: str, source: str, header: Header, way: str) -> Any:
        try:
            try:
                stamp = Time.from_msg(header.stamp)
                return self._buffer.lookup_transform(target, source, stamp).transform
            except self._tf2_ros.ExtrapolationException:
                # The newest: a sensor is fixed to its vehicle, and waiting would delay the cloud.
                return self._buffer.lookup_transform(target, source, Time()).transform
        except self._tf2_ros.TransformException as error:
            raise PointCloudError(f'no transform {way}: {error}') from error

    def time_jumped(self, seconds: float) -> None:
        """Forget all transforms after a long jump back."""
        if seconds > TF_JUMP:
            self._buffer.clear()

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()
