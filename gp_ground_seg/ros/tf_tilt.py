"""Tilt of the sensor by TF, with ``frame.level: tf``."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Quaternion
from rclpy.node import Node
from rclpy.time import Time

from gp_ground_seg.errors import MissingDependencyError, PointCloudError
from gp_ground_seg.pipeline.tilt import angles_of


def require_tf2() -> Any:
    """Return the module tf2_ros; raise a MissingDependencyError if it is not installed."""
    try:
        return importlib.import_module('tf2_ros')
    except ImportError as error:
        raise MissingDependencyError(
            f'frame.level = tf: needs tf2_ros, which cannot be imported ({error}): sudo apt '
            'install ros-jazzy-tf2-ros-py, or use frame.level = sensor with sensor.roll and '
            'sensor.pitch'
        ) from error


def tilt_of(rotation: Quaternion) -> tuple[float, float]:
    """Return roll and pitch [rad] of a sensor frame that `rotation` turns into a level one.

    Raises a PointCloudError if it is no rotation.
    """
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    square = x * x + y * y + z * z + w * w
    if not abs(square - 1.0) < 1e-3:
        raise PointCloudError(
            f'quaternion ({x:g}, {y:g}, {z:g}, {w:g}) of length {square**0.5:g}: must be 1'
        )
    # Third row of its matrix: the level frame's z axis in the sensor frame.
    up = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), square - 2.0 * (x * x + y * y)])
    return angles_of(up / np.linalg.norm(up))


class TfTilt:
    """Listens to TF in the executor of `node`."""

    def __init__(self, node: Node) -> None:
        self._tf2_ros = require_tf2()
        # Without the node: given one, the buffer clears itself at jumps of the node's clock,
        # and in some releases raises an error there that ends the executor. See `reset`.
        self._buffer = self._tf2_ros.Buffer()
        self._listener = self._tf2_ros.TransformListener(self._buffer, node, spin_thread=False)

    def tilt(self, frame: str, stamp: TimeMessage, base: str) -> tuple[float, float]:
        """Return roll and pitch [rad] of the frame `frame` in the frame `base`.

        The transform is that of the time `stamp`, or the newest if there is none for it: a
        sensor is fixed to its vehicle, and waiting for TF would delay every cloud. Raises a
        PointCloudError if TF does not connect the two.
        """
        try:
            try:
                found = self._buffer.lookup_transform(base, frame, Time.from_msg(stamp))
            except self._tf2_ros.ExtrapolationException:
                found = self._buffer.lookup_transform(base, frame, Time())
        except self._tf2_ros.TransformException as error:
            raise PointCloudError(
                f'no transform from its frame {frame!r} to frame.base = {base!r}: {error}'
            ) from error
        return tilt_of(found.transform.rotation)

    def reset(self) -> None:
        """Forget all transforms, as after a jump in time."""
        self._buffer.clear()

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()
