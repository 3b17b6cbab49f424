"""A short-lived ROS node for a command, in a context of its own."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from gp_ground_seg.ros.arguments import check_ros_arguments
from gp_ground_seg.ros.startup import start_errors

INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What ends a command in good order: Ctrl-C, kill, a closed terminal."""


class Session:
    """A node and the time it spends waiting; made by `ros_session`.

    Attributes
    ----------
    node : Node
        The node; it has no parameter services and does not log to /rosout.
    """

    def __init__(self, node: Node) -> None:
        self.node = node
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._is_interrupted = False
        self._holds_back = False

    def sleep(self, seconds: float) -> None:
        """Wait without handling messages; as exact as the system's clock is."""
        time.sleep(seconds)
        self.check()

    def spin(self, seconds: float) -> None:
        """Handle one message, or wait that long for it."""
        self._executor.spin_once(timeout_sec=seconds)
        self.check()

    def interrupt(self, _number: int, _frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, now and at the next wait."""
        self._is_interrupted = True
        if not self._holds_back:
            raise KeyboardInterrupt

    @contextmanager
    def holding_back(self) -> Iterator[None]:
        """Let a signal within the block be raised at the next `check` only."""
        self._holds_back = True
        try:
            yield
        finally:
            self._holds_back = False

    def close(self) -> None:
        """Tell the network that the node goes, so that nobody waits for it."""
        self._executor.shutdown()
        self.node.destroy_node()

    def check(self, cause: Exception | None = None) -> None:
        """Raise KeyboardInterrupt once interrupted; `cause` is what it was taken for.

        Python swallows an exception that a signal raises within a destructor or a
        callback: whatever takes long has to ask now and then.
        """
        if self._is_interrupted:
            raise KeyboardInterrupt from cause


@contextmanager
def ros_session(name: str, ros_args: Sequence[str] = ()) -> Iterator[Session]:
    """Yield a `Session`; SIGINT, SIGTERM and SIGHUP, unless ignored, interrupt the block.

    Parameters
    ----------
    name : str
        Name of the node.
    ros_args : sequence of str
        ``--ros-args`` and what follows it, or nothing.

    Raises
    ------
    ConfigError
        If the ROS arguments cannot be read.
    """
    check_ros_arguments(ros_args)
    context = Context()
    with start_errors():
        rclpy.init(
            args=[name, *ros_args],
            context=context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
    try:
        with start_errors():
            node = rclpy.create_node(
                name, context=context, start_parameter_services=False, enable_rosout=False
            )
        session = Session(node)
        try:
            with _signals_to(session):
                yield session
        finally:
            session.close()
    finally:
        rclpy.try_shutdown(context=context)


@contextmanager
def _signals_to(session: Session) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # What is ignored on purpose, as by nohup, stays so.
    heeded = [number for number in INTERRUPTS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, session.interrupt) for number in heeded}
    try:
        yield
    except Exception as error:
        # An interrupt within rclpy's bindings may come out of them as another exception.
        session.check(error)
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
