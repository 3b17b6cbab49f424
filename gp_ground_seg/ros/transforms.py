"""Tilt and place of the sensor by TF."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from geometry_msgs.msg import Quaternion
from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Header

from gp_ground_seg.core.errors import MissingDependencyError, PointCloudError
from gp_ground_seg.core.parameters.config import NO_FRAME, FrameConfig
from gp_ground_seg.core.pipeline.tilt import angles_of

KEPT_JUMP = 1.0  # jump back up to which transforms are kept: a late stamp, no other run [s]


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
        tilt, origin, frame_id = None, None, header.frame_id
        if frame.level == 'tf':
            way = f'from its frame {frame_id!r} to frame.base = {frame.base!r}'
            tilt = tilt_of(self._transform(frame.base, frame_id, header, way).rotation)
        if frame.sensor != NO_FRAME:
            way = f'from frame.sensor = {frame.sensor!r} to its frame {frame_id!r}'
            place = self._transform(frame_id, frame.sensor, header, way).translation
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
        if seconds > KEPT_JUMP:
            self._buffer.clear()

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()
