"""The ROS 2 node, clouds in, ground and obstacles out; and as a managed node, with its bond."""

from __future__ import annotations

import dataclasses
import logging
import os
import sys
import time
import uuid
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from contextvars import ContextVar
from functools import partial
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.core import errors
from gp_ground_seg.core.backend import NumpyBackend, choose_backend
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import NODE_NAME
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.costmap import SegmentedCloud
from gp_ground_seg.data.point_cloud2 import read_xyz
from gp_ground_seg.ros import transforms
from gp_ground_seg.ros.arguments import initialize, start_errors, unused_files, with_file
from gp_ground_seg.ros.diagnostics import Diagnostics, by_what_was_set, kept_height
from gp_ground_seg.ros.input import STEADY_CLOCK, THROTTLED, CloudSubscription
from gp_ground_seg.ros.loader import CHANGED, FOLLOWS, STAYS, BackendLoader
from gp_ground_seg.ros.outputs import OutputPublishers
from gp_ground_seg.ros.parameters import ConfiguredNode, describe
from gp_ground_seg.ros.session import StopRequest, large_cloud_transport, stop_on_signals
from gp_ground_seg.ros.transforms import NO_FRAMES, Found, FrameListener, KeptPose

# Time between heartbeats [s], the same as in Nav2's own nodes: the manager connects after the
# first, and waits half of its bond_timeout for one.
BOND_PERIOD = 0.1
BOND_TIMEOUT = 4.0  # without a heartbeat the node counts as dead [s]: the manager's default
BOND_DEPTH = 5
LAST_WORDS = Duration(seconds=0.5)  # longest wait until the end of a bond is delivered
NO_BOND = (
    'package bond is not installed (apt install ros-jazzy-bond): set bond_timeout: 0.0 on a '
    'lifecycle manager of this node'
)
_SPEAKER: ContextVar[Node | None] = ContextVar('speaker', default=None)
"""The node whose cloud is segmented in this thread: what the library says then is about it."""


class GroundSegmentationNode(ConfiguredNode):
    """Subscribes to ``points``, publishes ``ground``, ``obstacles`` and /diagnostics.

    Each output keeps the header and every field of the input, bit for bit; a return is in
    exactly one of the two clouds, a point that is none in neither. The first clouds are segmented
    with numpy; the compiled backend, if wanted, is made meanwhile. A changed parameter takes
    effect with the next cloud. Where the height of the sensor is estimated, a cloud that does
    not show the ground well has the pose of the last one that did. Options are those of
    `rclpy.node.Node`. Raises a ConfigError if a given parameter is not accepted.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(NODE_NAME, **options)
        self._at_end = ExitStack()  # of what is not freed with a node of rclpy
        self._at_end.enter_context(errors.messages_passed_to(self._pass_on))
        self._frames: FrameListener | None = None
        # A guard condition runs in the executor, between two callbacks.
        self._loaded = self.create_guard_condition(self._change_backend)
        self._make_segmenter()
        try:
            self._start()
        except BaseException:
            self.destroy_node()
            raise

    def _make_segmenter(self) -> None:
        self._segmenter = GroundSegmenter(self.config, backend=NumpyBackend())
        self._is_compiled = False
        self._kept = KeptPose()
        self._loader: BackendLoader | None = None

    def _start(self) -> None:
        self.get_logger().info(describe(self.config, self.get_fully_qualified_name()))
        with start_errors():
            self._outputs = OutputPublishers(self)
            self._input = CloudSubscription(
                self, 'points', self._on_cloud, self._why_idle, self._on_time_jump
            )
        self._follow_frames(self.config)
        self._diagnostics = Diagnostics(self, self._input, self.config)
        self.warn_of_unused_parameters()
        self._load_backend(self.config)
        self._input.review()

    def _on_cloud(
        self, cloud: PointCloud2, arrival: float, n_lost: int, frames: Found = NO_FRAMES
    ) -> None:
        """Read a cloud, segment it, publish the result, and note it; or say why it is refused.

        It came at the time `arrival` of ``time.monotonic`` [s]; `n_lost` before it were lost.
        """
        if self._input.idle:
            return  # it has waited for TF or IMU, and is not wanted any more
        _SPEAKER.set(self)
        start, header = time.monotonic(), cloud.header
        self._diagnostics.input.arrived(arrival, cloud)
        self._diagnostics.processing.n_dropped += n_lost
        try:
            if isinstance(frames, Exception):
                raise frames
            # Code for the other precision would have to be compiled at the first start too.
            points = read_xyz(cloud, is_single=True)
            fallback = self._kept.fallback(header.frame_id)
            result = self._segmenter.segment(
                points, frames.tilt, frames.origin, fallback, frames.base
            )
            if self._kept.note(result.pose):
                text = f'on {self._input.topic}, {kept_height(result.pose)}'
                self.get_logger().warning(text, **THROTTLED)
            segmented = time.monotonic()
            self._outputs.publish(SegmentedCloud(cloud, result, self.config, points))
        except Exception as error:
            # The next cloud may be good.
            self._refuse(cloud, error)
            return
        publishing, waited = time.monotonic() - segmented, frames.waited
        stages = {'queue': start - arrival - waited, 'frames': waited, **result.timings}
        stages['publish'] = publishing
        self._diagnostics.published(result, arrival, stages, frames.age)

    def _why_idle(self) -> str:
        """Why no clouds are wanted now; empty if they are."""
        is_heard = not self.config.input.lazy or any(self._outputs.n_subscribers().values())
        return '' if is_heard else 'no output has a subscriber (input.lazy)'

    def _refuse(self, cloud: PointCloud2, error: Exception) -> None:
        if not self.context.ok():
            return  # publishing failed because the process ends
        is_bad = isinstance(error, errors.PointCloudError)
        said = str(error) if is_bad else f'{type(error).__name__}: {errors.in_one_line(error)}'
        reason = errors.shown(said)  # it may hold names of frames and fields
        self._diagnostics.input.refused(reason)
        self.get_logger().error(
            f'cloud on {self._input.topic} in frame {cloud.header.frame_id!r} refused: {reason}',
            **THROTTLED,
        )

    def check_config(self, config: Config) -> None:
        """Raise a GroundSegError if the backend or TF is asked for and not installed."""
        choose_backend(config.runtime.backend)
        transforms.check_tf2(config)

    def apply_config(self, config: Config) -> None:
        """Use `config` from the next cloud on; compiled code as soon as that is made."""
        _SPEAKER.set(self)
        self._load_backend(config)
        runtime = config.runtime if self._is_compiled else self._segmenter.config.runtime
        self._segmenter.configure(dataclasses.replace(config, runtime=runtime))
        self._kept = KeptPose()
        self._follow_frames(config)
        self._diagnostics.configure(config)

    def _pass_on(self, level: int, message: str) -> None:
        if _SPEAKER.get() not in (None, self):
            return  # it is about a cloud of another node in this process
        message = by_what_was_set(message, self.config.frame.level)
        # rclpy wants a line of code for each severity.
        if level >= logging.WARNING:
            self.get_logger().warning(message)
        else:
            self.get_logger().info(message)

    def _load_backend(self, config: Config) -> None:
        is_wanted, loader = choose_backend(config.runtime.backend) == 'numba', self._loader
        if is_wanted and loader is None:
            self.get_logger().info(FOLLOWS)
            self._loader = loader = BackendLoader(config, self._loaded.trigger)
            loader.start()
        self._diagnostics.processing.loader = loader if is_wanted else None

    def _change_backend(self) -> None:
        """Use the compiled backend from the next cloud on, if the parameters still say so."""
        loader = self._loader
        if loader is None or not loader.is_done:
            return  # it was one that is closed now
        if loader.backend is None:
            self.get_logger().warning(f'{STAYS}: {loader.error}')
            return
        self._is_compiled = True
        if choose_backend(self.config.runtime.backend) == 'numba':
            self._segmenter.use_backend(loader.backend)
            self.get_logger().info(f'{CHANGED}, after {loader.seconds:.1f} s')
        # Makes another backend if `runtime` has changed meanwhile.
        self._segmenter.configure(self.config)

    def _follow_frames(self, config: Config) -> None:
        """Listen to TF and IMU while the parameters ask for it; clouds wait for them then."""
        if self._frames is not None and config.frame != self._frames.config.frame:
            self._frames.close()
            self._frames = None
        if self._frames is None and (config.frame.level == 'imu' or transforms.is_tf_used(config)):
            self._frames = FrameListener(self, config, self._on_cloud)
        self._input.callback = self._frames.hold if self._frames else self._on_cloud

    def destroy_node(self) -> None:
        """Free what the node holds."""
        if self._loader is not None:
            self._loader.close()
        super().destroy_node()
        self._at_end.close()

    def _on_time_jump(self, seconds: float) -> None:
        self._kept = KeptPose()
        if self._frames is not None:
            self._frames.time_jumped(seconds)
        self._diagnostics.input.time_jumped()


class ManagedNode(LifecycleNodeMixin, GroundSegmentationNode):  # type: ignore[misc]
    """A `GroundSegmentationNode` that begins and ends with the transitions of ROS.

    *configure* begins to make the compiled backend: for a minute *active* may mean numpy.
    *activate* subscribes, and begins the bond that Nav2's lifecycle manager waits for;
    *deactivate* ends both; *cleanup*, *shutdown* and an error free the backend. Parameters can be
    set in every state. Options are those of `rclpy.node.Node`.
    """

    _is_configured = _is_active = False
    _heartbeat: Heartbeat | None = None

    def __init__(self, **options: Any) -> None:
        GroundSegmentationNode.__init__(self, **options)
        LifecycleNodeMixin.__init__(self)
        self._at_end.callback(self._state_machine.destroy_when_not_in_use)  # with its services
        # At an impossible transition rclpy's own callback raises, and the caller gets no answer.
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = partial(self._answer, service.callback)

    def _answer(self, change: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        """Do what rclpy's callback `change` does; refuse a transition that is impossible."""
        try:
            return change(request, response)
        except RuntimeError:  # of rcl
            response.success = False
            wanted = f'{request.transition.id} {errors.shown(request.transition.label)}'.strip()
            text = f'transition {wanted} refused: it is not possible in the present state'
            self.get_logger().warning(text, **THROTTLED)
            return response

    def _load_backend(self, config: Config) -> None:
        if self._is_configured:
            super()._load_backend(config)

    def _why_idle(self) -> str:
        return super()._why_idle() if self._is_active else 'the node is not active'

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to make the compiled backend."""
        self._is_configured = True
        self._load_backend(self.config)
        return TransitionCallbackReturn.SUCCESS

    def _set_active(self, is_active: bool) -> TransitionCallbackReturn:
        self._is_active = is_active
        self._input.review()
        if self._heartbeat is not None:
            self._heartbeat.stop()
            self._heartbeat = None
        if is_active and (bond := transforms.find_module('bond.msg')) is not None:
            self._heartbeat = Heartbeat(self, bond.Status)
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
        if self._loader is not None:
            self._loader.close()
        self._make_segmenter()
        return self._set_active(False)

    on_shutdown = on_error = on_cleanup


class Heartbeat:
    """Publishes on ``bond`` that `node` is alive, until `stop`, which says that it ends.

    `message` is the type bond/msg/Status. The bond has the name of the node, as with Nav2's own
    nodes. It is published by the executor of the node: a node that hangs sends no heartbeat.
    """

    def __init__(self, node: Node, message: Any) -> None:
        self._node, self._message = node, message
        # A new name each time: the manager takes a bond that has ended for dead.
        self._instance = str(uuid.uuid4())
        self._publisher = node.create_publisher(message, 'bond', BOND_DEPTH)
        self._timer = node.create_timer(BOND_PERIOD, self._beat, clock=STEADY_CLOCK)
        self._beat()

    def _beat(self, is_active: bool = True) -> None:
        status = self._message(
            id=self._node.get_name(),
            instance_id=self._instance,
            active=is_active,
            heartbeat_timeout=BOND_TIMEOUT,
            heartbeat_period=BOND_PERIOD,
        )
        status.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(status)

    def stop(self) -> None:
        """Say that the bond ends on purpose."""
        self._beat(False)
        # What is not yet delivered is lost when the publisher is destroyed.
        self._publisher.wait_for_all_acked(LAST_WORDS)
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)


def _spin(node: GroundSegmentationNode, stop: StopRequest) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok() and not stop.made:
        try:
            # Python handles a signal after the wait, not within it. A wait of less than the time
            # between two clouds would end in vain before each.
            executor.spin_once(timeout_sec=0.25)
        except Exception as error:
            # Of a callback, or of rclpy itself: at a negative time on /clock, for example.
            if rclpy.ok():
                reason = f'{type(error).__name__}: {errors.shown(errors.in_one_line(error))}'
                node.get_logger().error(reason, **THROTTLED)


def main(args: Sequence[str] | None = None, *, is_managed: bool = False) -> int:
    """Run a node until a signal or a shutdown; return 0, or 2 for an error at start."""
    words = [NODE_NAME, *(sys.argv[1:] if args is None else args)]
    node = None
    with stop_on_signals() as stop:
        try:
            # Both outputs at once are more than stock Fast DDS sends without loss.
            with large_cloud_transport():
                initialize(words)
                node = ManagedNode() if is_managed else GroundSegmentationNode()
            for line in unused_files(words, node.get_fully_qualified_name()):
                node.get_logger().warning(line)
            _spin(node, stop)
            if isinstance(node, ManagedNode) and rclpy.ok():
                node._set_active(False)  # with its bond
            node.get_logger().info(f'ends: {node._diagnostics.summary()}')
        except errors.GroundSegError as error:
            problem = with_file(str(error), words)
            sys.stderr.write(f'{NODE_NAME}: error: {errors.shown(problem)}\n')
            return 2
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
    if stop.made:
        # The end of the interpreter would free compiled code, or wait for LLVM, for seconds.
        sys.stdout.flush()
        os._exit(0)
    return 0
