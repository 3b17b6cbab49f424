"""A node in a second process. ROS is imported by what needs it: commands import this without."""

from __future__ import annotations

import contextlib
import secrets
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

from gp_ground_seg.core.errors import GroundSegError
from gp_ground_seg.ros.start_stop import (
    Session,
    child_command,
    large_cloud_transport,
    ros_session,
)

_RUN = 'from gp_ground_seg.ros.start_stop import run_node; sys.exit(run_node(sys.argv[1:]))'


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

    def _said(self) -> str:
        return self._log.read_text(encoding='utf-8', errors='replace')

    def log_tail(self) -> str:
        """Return the last lines of its output."""
        return '\n'.join(self._said().splitlines()[-20:])

    def is_settled(self) -> bool:
        """Return whether it has the backend that it keeps."""
        from gp_ground_seg.ros.warm_up import CHANGED, FOLLOWS, STAYS

        said = self._said()
        return FOLLOWS not in said or CHANGED in said or STAYS in said

    def check(self) -> None:
        """Raise a GroundSegError if it has ended."""
        code = self._process.poll()
        if code is not None:
            ended = f'was killed by signal {-code}' if code < 0 else f'ended with code {code}'
            raise GroundSegError(f'the node {ended}; its last words:\n{self.log_tail()}')


@contextlib.contextmanager
def private_session(name: str) -> Iterator[tuple[Session, list[str]]]:
    """Yield a session named `name` to talk to a `NodeProcess`, and the ROS arguments of that.

    Both are in a namespace of a random name, so that other nodes and other runs do not matter.
    """
    namespace = f'/gp_ground_seg_{secrets.token_hex(4)}'
    words = ['-r', f'__ns:={namespace}', '-r', '/diagnostics:=diagnostics']
    with large_cloud_transport(), ros_session(name, ['--ros-args', *words]) as session:
        yield session, words
