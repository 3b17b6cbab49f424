"""The node in a process of its own, on a network of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from gp_ground_seg.errors import GroundSegError

STOP_TIMEOUT = 5.0
"""Time the node has to end in good order [s]."""
HIGHEST_DOMAIN = 101
"""Higher ones meet the ports that Linux hands out."""
N_LOG_LINES = 20
_NETWORK_VARIABLES = ('ROS_STATIC_PEERS', 'ROS_LOCALHOST_ONLY')


@contextlib.contextmanager
def private_network() -> Iterator[None]:
    """Keep this process and its children to this machine, on a ROS domain of their own.

    A robot on the same network neither hears nor disturbs them.
    """
    kept = dict(os.environ)
    for name in _NETWORK_VARIABLES:
        os.environ.pop(name, None)
    domain = 1 + os.getpid() % HIGHEST_DOMAIN
    if str(domain) == kept.get('ROS_DOMAIN_ID'):
        domain = 1 + domain % HIGHEST_DOMAIN
    os.environ['ROS_DOMAIN_ID'] = str(domain)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    try:
        yield
    finally:
        for name in (*_NETWORK_VARIABLES, 'ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE'):
            os.environ.pop(name, None)
            if name in kept:
                os.environ[name] = kept[name]


class NodeProcess:
    """``python -m gp_ground_seg node`` in a second process; use it in a ``with`` statement.

    It ends with the block, whatever happens in it.

    Parameters
    ----------
    log : Path
        File for all it says.
    ros_args : sequence of str
        What follows ``--ros-args``.
    uninterrupted : callable
        Returns a context in which a signal does not raise an exception.
    """

    def __init__(
        self,
        log: Path,
        ros_args: Sequence[str] = (),
        uninterrupted: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self._log = log
        self._uninterrupted = uninterrupted
        self._command = [sys.executable, '-m', 'gp_ground_seg', 'node', '--ros-args', *ros_args]

    def __enter__(self) -> NodeProcess:
        """Start it."""
        # Between the start of the process and the knowledge of it nothing could end it.
        with self._log.open('wb') as log, self._uninterrupted():
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )
        return self

    def __exit__(self, *_error: object) -> None:
        """Stop it."""
        self._process.terminate()
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(STOP_TIMEOUT)
        finally:
            # Also when interrupted while waiting; does nothing to a process that has ended.
            self._process.kill()
            self._process.wait()

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._process.pid

    def log_tail(self) -> str:
        """Return the last lines it said."""
        lines = self._log.read_text(encoding='utf-8', errors='replace').splitlines()
        return '\n'.join(lines[-N_LOG_LINES:])

    def check(self) -> None:
        """Raise a GroundSegError if it has ended."""
        code = self._process.poll()
        if code is not None:
            ended = f'was killed by signal {-code}' if code < 0 else f'ended with code {code}'
            raise GroundSegError(f'the node {ended}; its last words:\n{self.log_tail()}')
