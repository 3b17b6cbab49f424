"""The managed node: told when to compile, to listen, and to free what it holds."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from gp_ground_seg.core.errors import shown
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.ros import node
from gp_ground_seg.ros.heartbeat import NO_BOND, Heartbeat, find_message
from gp_ground_seg.ros.input import THROTTLED
from gp_ground_seg.ros.start_stop import StopRequest


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


def main(args: Sequence[str] | None = None) -> int:
    """Run the managed node as `gp_ground_seg.ros.node.main` runs the plain one."""
    return node.main(args, ManagedNode)
