"""The node as a process: this one, or a second one that clouds are sent to.

Functions import ROS themselves: commands import this module where there is no ROS.
"""

from __future__ import annotations

import contextlib
import secrets
import subprocess
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from gp_ground_seg.core.errors import GroundSegError
from gp_ground_seg.data.bags import decode_cloud, encode_cloud, with_stamp
from gp_ground_seg.data.point_cloud2 import CloudMessage, stamp_of
from gp_ground_seg.ros.loader import CHANGED, child_command
from gp_ground_seg.ros.session import (
    Session,
    large_cloud_transport,
    needing_ros,
    ros_session,
    stop_on_signals,
)

INPUT, GROUND, OBSTACLES = 'points', 'ground', 'obstacles'  # topics of the node
OUTPUTS = (GROUND, OBSTACLES)
DEPTH = 10  # clouds that may wait to be sent, or taken
LONGEST_WAIT = 120.0  # for an answer, on a slow machine that does much else [s]

_RUN = f'from {__name__} import run_node; sys.exit(run_node(sys.argv[1:]))'


def run_node(words: Sequence[str], *, is_managed: bool = False) -> int:
    """Run a node in this process until a signal; return its exit code.

    `words` are the arguments of the process. Raises a MissingDependencyError without ROS.
    """
    # Importing ROS takes a second, or several beside others, and leaves nothing to free.
    with stop_on_signals() as stop:
        stop.ends_process = True
        with needing_ros('the node'):
            from gp_ground_seg.ros.node import main
        return main(words, is_managed=is_managed)


class NodeProcess:
    """A node in a second process, for a ``with`` statement; its output goes to the file `log`.

    It ends when this process does, however that ends.
    """

    def __init__(self, log: Path, ros_args: Sequence[str] = ()) -> None:
        self._log = log
        self._command = [*child_command(_RUN), '--ros-args', *ros_args]

    def __enter__(self) -> NodeProcess:
        """Start it."""
        with self._log.open('wb') as log:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT
            )
        self.pid = self._process.pid
        return self

    def __exit__(self, *_error: object) -> None:
        """Stop it."""
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(5.0)
        self._process.kill()  # does nothing to a process that has ended
        self._process.communicate()

    def log_lines(self) -> list[str]:
        """Return the lines of its output."""
        return self._log.read_text(encoding='utf-8', errors='replace').splitlines()

    def is_compiled(self) -> bool:
        """Return whether it segments with compiled code by now."""
        return any(CHANGED in line for line in self.log_lines())

    def check(self) -> None:
        """Raise a GroundSegError if it has ended."""
        code = self._process.poll()
        if code is not None:
            ended = f'was killed by signal {-code}' if code < 0 else f'ended with code {code}'
            raise GroundSegError(f'the node {ended}')


@contextlib.contextmanager
def private_session(name: str) -> Iterator[tuple[Session, list[str]]]:
    """Yield a session named `name` to talk to a `NodeProcess`, and the ROS arguments of that.

    Both are in a namespace of a random name, so that other nodes and other runs do not matter.
    """
    namespace = f'/gp_ground_seg_{secrets.token_hex(4)}'
    words = ['-r', f'__ns:={namespace}', '-r', '/diagnostics:=diagnostics']
    with large_cloud_transport(), ros_session(name, ['--ros-args', *words]) as session:
        yield session, words


class Link:
    """Sends clouds to a node, and takes the ground and the obstacles of each."""

    def __init__(self, session: Session, node: NodeProcess) -> None:
        from sensor_msgs.msg import PointCloud2

        self._session, self._node = session, node
        self._back: dict[int, dict[str, CloudMessage]] = {}
        self._publisher = session.publisher_of_clouds(INPUT, DEPTH)
        for topic in OUTPUTS:
            take = partial(self._take, topic)
            session.node.create_subscription(PointCloud2, topic, take, DEPTH, raw=True)

    def connect(self, cloud: CloudMessage) -> None:
        """Send a cloud until the node answers.

        A cloud that is sent before DDS has connected both sides is lost. Each time the node has
        twice as long to answer: it shares the processor with its compiler, and each cloud that is
        sent again is work for it.
        """
        first, patience = with_stamp(cloud, 10**9), 0.5
        while patience < LONGEST_WAIT and not self._is_answered(first, patience):
            patience *= 2.0
        self.ask(first)

    def ask(self, cloud: CloudMessage) -> dict[str, CloudMessage]:
        """Send a cloud; return what the node makes of it, by topic."""
        if not self._is_answered(cloud, LONGEST_WAIT):
            topics = ' and '.join(OUTPUTS)
            raise GroundSegError(f'no answer on {topics} within {LONGEST_WAIT:g} s')
        return self._back.pop(stamp_of(cloud.header))

    def _is_answered(self, cloud: CloudMessage, patience: float) -> bool:
        self._publisher.publish(encode_cloud(cloud))

        def is_back() -> bool:
            self._node.check()
            return len(self._back.get(stamp_of(cloud.header), ())) == len(OUTPUTS)

        return self._session.wait_for(is_back, patience)

    def _take(self, topic: str, raw: bytes) -> None:
        cloud = decode_cloud(raw)
        self._back.setdefault(stamp_of(cloud.header), {})[topic] = cloud
