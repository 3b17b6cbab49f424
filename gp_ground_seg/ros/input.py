"""The input: clouds, losses, QoS that follows the publishers, time jumps, tilt by TF."""

from __future__ import annotations

import functools
import importlib
import time
from array import array
from collections.abc import Callable, Mapping
from copy import copy
from typing import Any

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import Quaternion
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gp_ground_seg.data import point_cloud2
from gp_ground_seg.errors import ConfigError, MissingDependencyError, PointCloudError
from gp_ground_seg.pipeline.tilt import angles_of

INPUT_DEPTH = 5  # clouds that may wait to be processed: half a second of a LiDAR at 10 Hz
OUTPUT_DEPTH = 20  # clouds kept: Fast DDS may send a lost fragment again after 0.7 s only
MAX_DEPTH = 10_000
QOS_OVERRIDES = 'qos_overrides.'
JUMP_TOLERANCE = 0.5  # stamps of several sensors on one topic may be that much out of order [s]
STEADY_CLOCK = Clock(clock_type=ClockType.STEADY_TIME)  # the clock of a node may stand or jump
THROTTLED = {'throttle_duration_sec': 5.0, 'throttle_time_source_type': STEADY_CLOCK}
"""Options of messages that may come with every cloud."""

_CHOICES = {
    'reliability': ('reliable', 'best_effort', 'best_available', 'system_default'),
    'history': ('keep_last', 'keep_all', 'system_default'),
}


def message_data(values: npt.NDArray[Any]) -> array[int]:
    """Return the bytes of an array as the one type that rclpy takes without a look at each."""
    data = array('B')
    data.frombytes(np.ascontiguousarray(values).data.cast('B') if values.size else b'')
    return data


select_points = functools.partial(point_cloud2.select_points, as_data=message_data)


def check_overrides(given: Mapping[str, object]) -> None:
    """Raise a ConfigError if a ``qos_overrides`` parameter, of any topic, is not accepted."""
    for name, value in given.items():
        policy, expected = name.rpartition('.')[2], ''
        if policy == 'depth' and not (type(value) is int and 1 <= value <= MAX_DEPTH):
            expected = f'an integer in [1, {MAX_DEPTH}]'
        elif value not in _CHOICES.get(policy, (value,)):
            expected = f'one of {", ".join(_CHOICES[policy])}'
        if expected and name.startswith(QOS_OVERRIDES):
            raise ConfigError(f'{name} = {value!r}: must be {expected}')


def cloud_profile(depth: int = OUTPUT_DEPTH) -> QoSProfile:
    """Return the default of a cloud topic: reliable, volatile, the newest `depth` clouds."""
    return QoSProfile(depth=depth)


def in_words(profile: QoSProfile) -> str:
    """Return `profile` as in ``reliable, keep_last 5, volatile``."""
    reliability, history, durability = profile.reliability, profile.history, profile.durability
    return f'{reliability.name}, {history.name} {profile.depth}, {durability.name}'.lower()


class SequenceGaps:
    """Counts messages of one publisher, numbered 1, 2, 3 ... by it, that did not arrive.

    They were lost on the way, or overwritten in a full queue while the node was busy.
    """

    _last: int | None = None

    def reset(self) -> None:
        """Forget the last number: another publisher has its own count."""
        self._last = None

    def note(self, number: int | None) -> int:
        """Return how many messages are missing before the one with this `number`."""
        last, self._last = self._last, number
        if last is None or number is None or number <= last:
            return 0
        return number - last - 1


class CloudSubscription:
    """Subscription that is best-effort if a publisher is, and reliable otherwise.

    A best-effort reader loses most of a replayed KITTI bag with stock Fast DDS; a reliable one
    gets nothing from a best-effort LiDAR driver. Reliability given in ``qos_overrides``, by
    `is_given`, is kept for any publisher. `callback` takes each cloud, its wait in this process
    [s] and the clouds lost before it: 0 with several publishers, whose numbers tell nothing.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        is_given: Callable[[str], bool],
        callback: Callable[[PointCloud2, float, int], None],
    ) -> None:
        self._node = node
        self._unresolved_topic = topic
        self._callback = callback
        self._gaps = SequenceGaps()
        self._offered: dict[bytes, ReliabilityPolicy] = {}
        self.topic: str = node.resolve_topic_name(topic)
        self._is_pinned = is_given(f'qos_overrides.{self.topic}.subscription.reliability')
        # The executor still uses a subscription within its own event; a guard condition runs
        # after all that became ready with it.
        self._review_soon = node.create_guard_condition(self._review)
        self._subscription = self._create(
            cloud_profile(INPUT_DEPTH), QoSOverridingOptions.with_default_policies()
        )
        # The event can come before the publisher is listed, and there is no event for the end
        # of the last best-effort publisher: they are looked at every second too.
        node.create_timer(1.0, self._review_soon.trigger, clock=STEADY_CLOCK)

    @property
    def qos(self) -> QoSProfile:
        """Quality of service in use."""
        return self._subscription.qos_profile

    @property
    def qos_words(self) -> str:
        """`qos` as in ``reliable, keep_last 5, volatile``."""
        return in_words(self.qos)

    @property
    def n_publishers(self) -> int:
        """Publishers, as of the last look."""
        return len(self._offered)

    def _create(self, profile: QoSProfile, overrides: QoSOverridingOptions | None) -> Subscription:
        return self._node.create_subscription(
            PointCloud2,
            self._unresolved_topic,
            self._receive,
            profile,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible),
            qos_overriding_options=overrides,
        )

    def _receive(self, message: PointCloud2, info: dict[str, Any]) -> None:
        # Both are stamps of the system clock; 0 where the middleware gives none.
        now = time.time_ns()
        wait = max(0.0, 1e-9 * (now - (info.get('received_timestamp') or now)))
        if not self._offered:
            self._look_at_publishers()
        n_lost = self._gaps.note(info.get('publication_sequence_number'))
        if n_lost and (self._look_at_publishers() or self.n_publishers != 1):
            n_lost = 0
        self._callback(message, wait, n_lost)

    def _on_incompatible(self, _event: object) -> None:
        if self._is_pinned:
            self._node.get_logger().error(
                f'a publisher of {self.topic} does not offer what qos_overrides asks for '
                f'({self.qos_words}): nothing will arrive from it'
            )
        self._review_soon.trigger()

    def _look_at_publishers(self) -> bool:
        """Return whether the publishers have changed since the last look."""
        offered = {
            bytes(entry.endpoint_gid): entry.qos_profile.reliability
            for entry in self._node.get_publishers_info_by_topic(self.topic)
        }
        before, self._offered = self._offered, offered
        if has_changed := offered.keys() != before.keys():
            self._gaps.reset()
        return has_changed

    def _review(self) -> None:
        self._look_at_publishers()
        if not self._offered or self._is_pinned:
            return
        best_effort, reliable = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
        wanted = best_effort if best_effort in self._offered.values() else reliable
        profile = copy(self.qos)
        if profile.reliability == wanted:
            return
        profile.reliability = wanted
        self._node.get_logger().info(
            f'subscribing {in_words(profile)} to {self.topic}, as its publishers offer'
        )
        self._node.destroy_subscription(self._subscription)
        self._gaps.reset()
        self._subscription = self._create(profile, None)


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
    """Calls `on_jump` when the stamps of clouds, or the clock of `node`, jump back."""

    def __init__(self, node: Node, on_jump: Callable[[], None]) -> None:
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
        self._on_jump()
        self._node.get_logger().info(
            f'time jumped back by {seconds:.1f} s: what earlier clouds taught is forgotten',
            **THROTTLED,
        )


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
    """Return roll and pitch [rad] of a sensor frame that `rotation` turns into a level one."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    square = x * x + y * y + z * z + w * w
    if not abs(square - 1.0) < 1e-3:
        given = f'({x:g}, {y:g}, {z:g}, {w:g}) of length {square**0.5:g}'
        raise PointCloudError(f'quaternion {given}: must be 1')
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

    def tilt(self, header: Header, base: str) -> tuple[float, float]:
        """Return roll and pitch [rad] of a cloud in `base`; PointCloudError if TF has them not."""
        frame = header.frame_id
        try:
            try:
                found = self._buffer.lookup_transform(base, frame, Time.from_msg(header.stamp))
            except self._tf2_ros.ExtrapolationException:
                # The newest: a sensor is fixed to its vehicle, and waiting would delay the cloud.
                found = self._buffer.lookup_transform(base, frame, Time())
        except self._tf2_ros.TransformException as error:
            way = f'from its frame {frame!r} to frame.base = {base!r}'
            raise PointCloudError(f'no transform {way}: {error}') from error
        return tilt_of(found.transform.rotation)

    def reset(self) -> None:
        """Forget all transforms, as after a jump in time."""
        self._buffer.clear()

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()
