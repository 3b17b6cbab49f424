"""The managed node: told when to compile, to listen, and to free what it holds; and its bond."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from gp_ground_seg.core.errors import shown
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.ros import node
from gp_ground_seg.ros.input import STEADY_CLOCK, THROTTLED
from gp_ground_seg.ros.start_stop import StopRequest

# From one heartbeat to the next [s], as of Nav2's own nodes: the manager connects after the first,
# and waits half of its bond_timeout for one.
PERIOD = 0.1
TIMEOUT = 4.0  # without one until the node is taken for dead [s]: the manager's own default
DEPTH = 5
LAST_WORDS = Duration(seconds=0.5)  # longest wait until the end of a bond is delivered
NO_BOND = (
    'package bond is not installed (apt install ros-jazzy-bond): set bond_timeout: 0.0 on a '
    'lifecycle manager of this node'
)


class ManagedNode(LifecycleNodeMixin, node.GroundSegmentationNode):  # type: ignore[misc]
    """A `GroundSegmentationNode` that is told when to begin, by the transitions of ROS.

    *configure* makes the compiled backend and waits for it; *activate* subscribes, and begins the
    bond that Nav2's lifecycle manager waits for; *deactivate* ends both; *cleanup*, *shutdown* and
    an error free the backend. Parameters can be set in every state. Options are those of
    `rclpy.node.Node`.
    """

    _is_configured = _is_active = False
    _heartbeat: Heartbeat | None = None

    def __init__(self, stop: StopRequest, **options: Any) -> None:
        self._stop = stop
        node.GroundSegmentationNode.__init__(self, **options)
        LifecycleNodeMixin.__init__(self)
        # Where a transition is impossible, rclpy's own callback raises, and nobody is answered.
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = partial(self._answer, service.callback)

    def _answer(self, change: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        """Do what rclpy's callback `change` does; refuse a transition that there is not."""
        try:
            return change(request, response)
        except RuntimeError:  # of rcl
            response.success = False
            wanted = f'{request.transition.id} {shown(request.transition.label)}'.strip()
            text = f'transition {wanted} refused: it is not possible in the present state'
            self.get_logger().warning(text, **THROTTLED)
            return response

    def _load_backend(self, config: Config) -> None:
        if self._is_configured:
            super()._load_backend(config)

    def _why_idle(self) -> str:
        return super()._why_idle() if self._is_active else 'the node is not active'

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Make the compiled backend; fail if the process is asked to end meanwhile."""
        self._is_configured = True
        self._load_backend(self.config)
        while self._loader.is_busy:
            if self._stop.made:
                return TransitionCallbackReturn.FAILURE
            time.sleep(0.02)
        self._change_backend()
        return TransitionCallbackReturn.SUCCESS

    def _set_active(self, is_active: bool) -> TransitionCallbackReturn:
        self._is_active = is_active
        self._input.review()
        if self._heartbeat is not None:
            self._heartbeat.stop()
            self._heartbeat = None
        if is_active and (message := find_message()) is not None:
            self._heartbeat = Heartbeat(self, message)
        elif is_active:
            self.get_logger().info(NO_BOND)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe."""
        return self._set_active(True)

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """End the subscription."""
        return self._set_active(False)

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Free the backend."""
        self._is_configured = False
        self._loader.close()
        self._make_segmenter()
        return self._set_active(False)

    on_shutdown = on_error = on_cleanup


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
        # A publisher that is destroyed takes with it what is not yet delivered.
        self._publisher.wait_for_all_acked(LAST_WORDS)
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)


def main(args: Sequence[str] | None = None) -> int:
    """Run the managed node as `gp_ground_seg.ros.node.main` runs the plain one."""
    return node.main(args, ManagedNode)
