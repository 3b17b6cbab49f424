"""Time that jumps back: a bag played again, a simulation begun anew."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

TOLERANCE = 0.5
"""Stamps may be that much out of order [s]: several sensors on one topic are no jump."""
LOG_PERIOD = 5.0
"""Shortest time between two messages about it [s]."""


class StampWatch:
    """Sees from the stamps of clouds that time has jumped back."""

    def __init__(self) -> None:
        self._newest: float | None = None

    def reset(self) -> None:
        """Forget the newest stamp."""
        self._newest = None

    def note(self, stamp: float) -> float:
        """Return how far the `stamp` of a cloud lies before an earlier one's, 0 if no jump [s]."""
        newest, self._newest = self._newest, stamp
        if newest is None or stamp >= newest:
            return 0.0
        if newest - stamp <= TOLERANCE:
            self._newest = newest
            return 0.0
        return newest - stamp


class TimeJumps:
    """Tells when time has jumped back, be it that of the clouds or that of /clock.

    Parameters
    ----------
    node : Node
        Node whose clock is watched, and that logs a jump.
    on_jump : callable
        Called after each jump, in the executor of the node.
    """

    def __init__(self, node: Node, on_jump: Callable[[], None]) -> None:
        self._node = node
        self._on_jump = on_jump
        self._stamps = StampWatch()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        threshold = JumpThreshold(
            min_forward=None, min_backward=Duration(seconds=-TOLERANCE), on_clock_change=False
        )
        self._handle = node.get_clock().create_jump_callback(
            threshold, post_callback=self._clock_jumped
        )

    def note(self, stamp: float) -> None:
        """Take note of the `stamp` of a cloud [s]."""
        seconds = self._stamps.note(stamp)
        if seconds:
            self._tell(seconds)

    def close(self) -> None:
        """Watch the clock no longer."""
        self._handle.unregister()

    def _clock_jumped(self, jump: TimeJump) -> None:
        # The clouds follow: that is the same jump.
        self._stamps.reset()
        self._tell(-1e-9 * jump.delta.nanoseconds)

    def _tell(self, seconds: float) -> None:
        self._on_jump()
        self._node.get_logger().info(
            f'time jumped back by {seconds:.1f} s: what earlier clouds taught is forgotten',
            throttle_duration_sec=LOG_PERIOD,
            throttle_time_source_type=self._steady,
        )
