"""Judged tasks as ``diagnostic_msgs/DiagnosticArray`` on /diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from gp_ground_seg.ros.health.status import Level, Status

TOPIC = '/diagnostics'
NANOSECONDS = 1_000_000_000


class DiagnosticsPublisher:
    """Publishes what `report` returns, periodically.

    The period is that of a steady clock: with ``use_sim_time`` a timer on the
    node's clock would not fire before the first /clock, nor while a bag is paused.

    Parameters
    ----------
    node : Node
        Node that publishes.
    report : callable
        Returns the statuses; called in the executor of the node.
    period : float
        Time between two reports [s].
    """

    def __init__(self, node: Node, report: Callable[[], Iterable[Status]], period: float) -> None:
        self._node = node
        self._report = report
        self._publisher = node.create_publisher(DiagnosticArray, TOPIC, 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(period, self._publish, clock=steady)

    def set_period(self, period: float) -> None:
        """Change the time between two reports [s]; the next one comes that much from now."""
        period_ns = round(period * NANOSECONDS)
        if period_ns != self._timer.timer_period_ns:
            self._timer.timer_period_ns = period_ns
            self._timer.reset()

    def _publish(self) -> None:
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        node_name = self._node.get_fully_qualified_name().lstrip('/')
        try:
            statuses = list(self._report())
        except Exception as error:
            # Out of here it would end the node, for the sake of a report.
            statuses = [Status('diagnostics', Level.ERROR, f'{type(error).__name__}: {error}', {})]
        array.status = [to_message(status, node_name) for status in statuses]
        self._publisher.publish(array)


def to_message(status: Status, node_name: str) -> DiagnosticStatus:
    """Return `status` as a message named ``node: task``."""
    return DiagnosticStatus(
        level=bytes([status.level]),
        name=f'{node_name}: {status.task}',
        message=status.message,
        hardware_id='none',
        values=[KeyValue(key=key, value=value) for key, value in status.values.items()],
    )
