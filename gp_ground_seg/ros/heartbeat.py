"""The bond of the managed node: the heartbeat that Nav2's lifecycle manager waits for."""

from __future__ import annotations

import uuid
from typing import Any

from rclpy.node import Node

from gp_ground_seg.ros.input import STEADY_CLOCK

PERIOD = 1.0  # from one heartbeat to the next [s]
TIMEOUT = 4.0  # without one until the node is taken for dead [s]: the manager's own default
DEPTH = 5
NO_BOND = (
    'package bond is not installed (apt install ros-jazzy-bond): set bond_timeout: 0.0 on a '
    'lifecycle manager of this node'
)


def find_message() -> Any:
    """Return the type bond/msg/Status, None where the package is not installed."""
    try:
        from bond.msg import Status
    except ImportError:
        return None
    return Status


class Heartbeat:
    """Says on ``bond`` that a node lives, from its making until `stop`, which says the end of it.

    `message` is the type bond/msg/Status. The name of the node is the name of the bond, as Nav2's
    own nodes have it. It beats in the executor: a node that hangs is not alive.
    """

    def __init__(self, node: Node, message: Any) -> None:
        self._node, self._message = node, message
        # Each bond is a new one: the manager takes an old one for dead.
        self._instance = str(uuid.uuid4())
        self._publisher = node.create_publisher(message, 'bond', DEPTH)
        self._timer = node.create_timer(PERIOD, self._beat, clock=STEADY_CLOCK)
        self._beat()

    def _beat(self, is_active: bool = True) -> None:
        status = self._message(
            id=self._node.get_name(),
            instance_id=self._instance,
            active=is_active,
            heartbeat_timeout=TIMEOUT,
            heartbeat_period=PERIOD,
        )
        status.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(status)

    def stop(self) -> None:
        """Say that the bond ends on purpose."""
        self._beat(False)
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)
