"""The ROS 2 node: clouds in, ground and obstacles out; compiled code is made meanwhile."""

from __future__ import annotations

import dataclasses
import importlib
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.core.backend import Backend, NumpyBackend, choose_backend
from gp_ground_seg.core.errors import (
    GroundSegError,
    PointCloudError,
    in_one_line,
    messages_passed_to,
    shown,
)
from gp_ground_seg.core.jit import code_folder, is_code_kept
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import NODE_NAME
from gp_ground_seg.core.segmenter import GroundSegmenter, warm_up
from gp_ground_seg.data.costmap import SegmentedCloud
from gp_ground_seg.data.point_cloud2 import read_xyz
from gp_ground_seg.ros import start_stop
from gp_ground_seg.ros.diagnostics import Diagnostics, InputFacts, kept_height
from gp_ground_seg.ros.input import THROTTLED, CloudSubscription, clock_fault
from gp_ground_seg.ros.outputs import OutputPublishers
from gp_ground_seg.ros.parameters import ConfiguredNode, describe
from gp_ground_seg.ros.start_stop import child_command
from gp_ground_seg.ros.transforms import (
    CloudFrames,
    FrameListener,
    KeptPose,
    is_listening,
    is_tf_used,
    require_tf2,
)

FOLLOWS = (
    'segmenting with numpy until the compiled code is there: a second, or 20 to 60 s to compile it'
)
CHANGED = 'segmenting with numba now'
STAYS = 'segmenting with numpy from now on'
JOIN_TIMEOUT = 0.5  # longest wait for the thread [s]

# Looking for garbage less often, as the commands do, saves a tenth of the time.
_COMPILE = 'import gc; gc.set_threshold(50_000); ' + (
    'from gp_ground_seg.core.segmenter import warm_up; warm_up()'
)


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
        self._library_log = ExitStack()
        self._library_log.enter_context(messages_passed_to(self._pass_on))
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
        self._loader = BackendLoader(self._loaded.trigger)

    def _start(self) -> None:
        logger = self.get_logger()
        logger.info(describe(self.config, self.get_fully_qualified_name()))
        with start_stop.start_errors():
            self._outputs = OutputPublishers(self)
            self._input = CloudSubscription(
                self, 'points', self._on_cloud, self._why_idle, self._on_time_jump
            )
        self._follow_frames(self.config)
        self._diagnostics = Diagnostics(self, self._state, self.config.diagnostics)
        self.warn_of_unused_parameters()
        self._load_backend(self.config)
        self._input.review()

    def _on_cloud(self, cloud: PointCloud2, arrival: float, n_lost: int) -> None:
        """Read a cloud, segment it, publish the result, and note it; or say why it is refused.

        It came at the time `arrival` of ``time.monotonic`` [s], and `n_lost` before it did not.
        """
        if self._input.idle:
            return  # it has waited for TF or IMU, and is not wanted any more
        start, header = time.monotonic(), cloud.header
        self._diagnostics.arrived(cloud, arrival, n_lost)
        try:
            # Code for the other precision would have to be compiled at the first start too.
            points = read_xyz(cloud, is_single=True)
            frames = self._frames.look_up(header) if self._frames else CloudFrames()
            fallback = self._kept.fallback(header.frame_id)
            result = self._segmenter.segment(
                points, frames.tilt, frames.origin, fallback, frames.base
            )
            if self._kept.note(result.pose):
                text = f'on {self._input.topic}, {kept_height(result.pose)}'
                self.get_logger().warning(text, **THROTTLED)
            segmented = time.monotonic()
            topics = self._outputs.publish(
                SegmentedCloud(cloud, result, self.config, frames.output)
            )
        except Exception as error:
            # The next cloud may be good.
            self._refuse(cloud, error)
            return
        publishing = time.monotonic() - segmented
        stages = {'queue': start - arrival, **result.timings, 'publish': publishing}
        self._diagnostics.published(result, arrival, stages, topics)

    def _why_idle(self) -> str:
        """Why no clouds are wanted now; empty if they are."""
        is_heard = not self.config.input.lazy or any(self._outputs.n_subscribers().values())
        return '' if is_heard else 'no output has a subscriber (input.lazy)'

    def _refuse(self, cloud: PointCloud2, error: Exception) -> None:
        if not self.context.ok():
            return  # publishing failed because the process ends
        is_bad = isinstance(error, PointCloudError)
        said = str(error) if is_bad else f'{type(error).__name__}: {in_one_line(error)}'
        reason = shown(said)  # it may hold names of frames and fields
        self._diagnostics.input.refused(reason)
        self.get_logger().error(
            f'cloud on {self._input.topic} in frame {cloud.header.frame_id!r} refused: {reason}',
            **THROTTLED,
        )

    def check_config(self, config: Config) -> None:
        """Raise a GroundSegError if the backend or TF is asked for and not installed."""
        choose_backend(config.runtime.backend)
        if is_tf_used(config):
            require_tf2(config)

    def apply_config(self, config: Config) -> None:
        """Use `config` from the next cloud on; compiled code as soon as that is made."""
        self._load_backend(config)
        runtime = config.runtime if self._is_compiled else self._segmenter.config.runtime
        self._segmenter.configure(dataclasses.replace(config, runtime=runtime))
        self._kept.forget()
        self._follow_frames(config)
        self._diagnostics.configure(config.diagnostics)

    def _pass_on(self, level: int, message: str) -> None:
        # rclpy wants a line of code for each severity.
        if level >= logging.WARNING:
            self.get_logger().warning(message)
        else:
            self.get_logger().info(message)

    def _load_backend(self, config: Config) -> None:
        if not self._loader.is_started and choose_backend(config.runtime.backend) == 'numba':
            self.get_logger().info(FOLLOWS)
            self._loader.start(config)

    def _change_backend(self) -> None:
        """Use the compiled backend from the next cloud on, if the parameters still say so."""
        if not self._loader.is_ready:
            return
        backend = self._loader.take_backend()
        if backend is None:
            self.get_logger().warning(f'{STAYS}: {self._loader.error}')
            return
        self._is_compiled = True
        if choose_backend(self.config.runtime.backend) == 'numba':
            self._segmenter.use_backend(backend)
            self.get_logger().info(f'{CHANGED}, after {self._loader.seconds:.1f} s')
        # Where `runtime` has changed meanwhile, this makes another backend.
        self._segmenter.configure(self.config)

    def _follow_frames(self, config: Config) -> None:
        """Listen to TF and IMU while the parameters ask for it; clouds wait for them then."""
        before = self._frames.config if self._frames else Config()
        is_same = (config.frame, config.output.frame) == (before.frame, before.output.frame)
        if self._frames is not None and not is_same:
            self._frames.close()
            self._frames = None
        if self._frames is None and is_listening(config):
            self._frames = FrameListener(self, config, self._on_cloud)
        self._input.callback = self._frames.hold if self._frames else self._on_cloud

    @property
    def is_compiling(self) -> bool:
        """Whether the compiled backend is being made, in a thread of this process."""
        return self._loader.is_busy

    def destroy_node(self) -> None:
        """Free what the node holds."""
        self._loader.stop()
        # The network before the thread of the loader: it may end late.
        super().destroy_node()
        self._loader.close()
        self._library_log.close()

    def _on_time_jump(self, seconds: float) -> None:
        self._kept.forget()
        if self._frames is not None:
            self._frames.time_jumped(seconds)
        self._diagnostics.input.time_jumped()

    def _state(self) -> tuple[InputFacts, dict[str, int]]:
        clock = self.get_clock()
        source, now = self._input, 1e-9 * clock.now().nanoseconds
        is_simulated = clock.ros_time_is_active
        if no_time := clock_fault(clock):
            self.get_logger().warning(no_time, once=True)
        faults = '; '.join(filter(None, (source.fault, no_time)))
        facts = InputFacts(
            source.topic, source.qos_words, source.n_publishers, now, is_simulated, faults,
            source.idle,
        )  # fmt: skip
        return facts, self._outputs.n_subscribers()


class BackendLoader:
    """Makes the compiled backend in a thread, while frames are segmented without it.

    `on_done` is called there when the backend is made or cannot be made; not after `stop`.
    """

    error = ''
    seconds = 0.0
    is_ready = False
    """Whether `take_backend` has a result that was not taken yet."""
    _backend: Backend | None = None
    _is_stopped = False
    _compiler: subprocess.Popen[bytes] | None = None
    _thread: threading.Thread | None = None

    def __init__(self, on_done: Callable[[], None]) -> None:
        self._on_done = on_done
        self._lock = threading.Lock()

    @property
    def is_started(self) -> bool:
        """Whether `start` has been called."""
        return self._thread is not None

    @property
    def is_busy(self) -> bool:
        """Whether the thread runs."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, config: Config) -> None:
        """Begin to make the backend for `config`."""
        self._thread = threading.Thread(target=self._run, args=(config,), daemon=True)
        self._thread.start()

    def take_backend(self) -> Backend | None:
        """Return the backend, once; None if it cannot be made, and `error` says why."""
        backend, self._backend, self.is_ready = self._backend, None, False
        return backend

    def stop(self) -> None:
        """End the compiling process; `on_done` is not called from now on."""
        with self._lock:
            self._is_stopped = True
            if self._compiler is not None:
                self._compiler.kill()

    def close(self) -> None:
        """Stop, and wait for the thread.

        A thread that compiles in this process, as where no folder can keep the code, does so for
        20 to 60 s: nobody waits for it.
        """
        self.stop()
        if self._thread is not None:
            self._thread.join(JOIN_TIMEOUT)

    def _run(self, config: Config) -> None:
        start = time.monotonic()
        backend = None
        try:
            # What is kept is known once the compiled functions are declared.
            importlib.import_module('gp_ground_seg.core.compiled.backend')
            if code_folder() is not None and not is_code_kept():
                self._compile()
            if not self._is_stopped:
                # A given height is not that of the scan which is segmented for this.
                backend = warm_up(dataclasses.replace(config, sensor=Config().sensor))
        except Exception as error:
            self.error = f'{type(error).__name__}: {error}'
        self.seconds = time.monotonic() - start
        with self._lock:
            if not self._is_stopped:
                self._backend, self.is_ready = backend, True
                self._on_done()

    def _compile(self) -> None:
        """Compile in a child process, whose memory is free after it: twice what the node needs."""
        with self._lock:
            if self._is_stopped:
                return
            pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
            self._compiler = subprocess.Popen(
                child_command(_COMPILE),
                cwd='/',
                stdin=pipe,
                stdout=nowhere,
                stderr=pipe,
            )
        with self._compiler:
            assert self._compiler.stderr is not None
            said = self._compiler.stderr.read().decode(errors='replace').strip()
            code = self._compiler.wait()
        if code and not self._is_stopped:
            reason = said.splitlines()[-1] if said else f'exit code {code}'
            raise RuntimeError(f'the compiling process failed: {reason}')


def _spin(node: GroundSegmentationNode, stop: start_stop.StopRequest) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok() and not stop.made:
        try:
            # Python handles a signal after the wait, not within it.
            executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            return
        except Exception as error:
            # Of a callback, or of rclpy itself: at a negative time on /clock, for example.
            if rclpy.ok():
                reason = f'{type(error).__name__}: {shown(in_one_line(error))}'
                node.get_logger().error(reason, **THROTTLED)


def main(
    args: Sequence[str] | None = None,
    make_node: Callable[[start_stop.StopRequest], GroundSegmentationNode] = (
        lambda _stop: GroundSegmentationNode()
    ),
) -> int:
    """Run the node until a signal or a shutdown; return 0, or 2 for an error at start."""
    words = [NODE_NAME, *(sys.argv[1:] if args is None else args)]
    node = None
    with start_stop.stop_on_signals() as stop:
        try:
            # Both outputs at once are more than stock Fast DDS sends without loss.
            with start_stop.large_cloud_transport():
                start_stop.initialize(words)
                node = make_node(stop)
            for line in start_stop.unused_files(words, node.get_fully_qualified_name()):
                node.get_logger().warning(line)
            _spin(node, stop)
        except GroundSegError as error:
            problem = start_stop.with_file(str(error), words)
            sys.stderr.write(f'{NODE_NAME}: error: {shown(problem)}\n')
            return 2
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
    if node is not None and node.is_compiling:
        # The end of the interpreter would wait for LLVM, for ten seconds and more.
        os._exit(0)
    return 0
