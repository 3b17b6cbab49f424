"""Compiled code for a node, made while the node segments without it."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from gp_ground_seg.core.jit import DURATION
from gp_ground_seg.core.parameters.config import Config

if TYPE_CHECKING:
    from gp_ground_seg.core.backend import Backend

FOLLOWS = f'segmenting with numpy until compiled code is there: a second, or {DURATION} to compile'
CHANGED = 'segmenting with numba now'
STAYS = 'segmenting with numpy from now on'
JOIN_TIMEOUT = 0.5  # longest wait for the thread [s]

PROCESSES = 'learn_frame', 'estimate_surface'
OTHERS = 'find_planes', 'find_faces', 'find_relief', 'extract_lines', 'label_points'
"""Stages of a frame after the grid, of which the first take as long to compile as the others. They
share the growth of inliers, which one process compiles once."""
# Collecting garbage less often, as the commands do, saves a tenth of the time.
_QUICKLY = 'import gc; gc.set_threshold(50_000); from gp_ground_seg.ros import loader; '
_COMPILE_PROCESSES = f'{_QUICKLY} loader.compile_but(*{OTHERS})'
# Behind what the robot does: its child inherits this, and two such weigh less than one process.
_COMPILE = f'{_QUICKLY} os.nice(4); loader.compile_all()'
_CHILD = """\
import os, signal, sys, threading
sys.path[:] = {path!r}
# Standard input ends when the process that has started this one does.
end = lambda: (os.read(0, 1), os.kill(os.getpid(), signal.SIGTERM))
threading.Thread(target=end, daemon=True).start()
{code}
"""


def child_command(code: str) -> list[str]:
    """Return the command of a Python process that runs `code`, and ends when this one does.

    Start it with a pipe as standard input. It imports what this process does, and nothing from
    the current folder, which may be any.
    """
    path = [entry for entry in sys.path if os.path.isabs(entry)]
    return [sys.executable, '-c', _CHILD.format(path=path, code=code)]


def compile_all() -> None:
    """Compile all code that a frame needs; where there are two cores, with a child process."""
    from gp_ground_seg.core.jit import code_folder, is_code_kept
    from gp_ground_seg.core.segmenter import warm_up

    is_shared = code_folder() is not None and len(os.sched_getaffinity(0)) > 1
    if is_shared and not is_code_kept():
        # Where it fails, this process compiles that too.
        command, pipe = child_command(_COMPILE_PROCESSES), subprocess.PIPE
        with subprocess.Popen(command, cwd='/', stdin=pipe, stderr=subprocess.DEVNULL):
            compile_but(*PROCESSES)
    warm_up()


def compile_but(*stages: str) -> None:
    """Compile the code of a frame but for some stages, which numpy does."""
    from gp_ground_seg.core.backend import NumpyBackend, make_backend
    from gp_ground_seg.core.segmenter import warm_up

    backend = make_backend(Config().runtime)
    for stage in stages:
        setattr(backend, stage, getattr(NumpyBackend, stage))
    warm_up(backend=backend)


class BackendLoader(threading.Thread):
    """Makes the compiled backend for `config`, while frames are segmented without it.

    `on_done` is called in this thread when `backend` is made, or cannot be made, and `error` says
    why; not after `close`.
    """

    error = ''
    seconds = 0.0
    is_done = False
    backend: Backend | None = None
    _is_closed = False
    _compiler: subprocess.Popen[bytes] | None = None

    def __init__(self, config: Config, on_done: Callable[[], None]) -> None:
        super().__init__(daemon=True)
        self._config, self._on_done = config, on_done
        self._lock = threading.Lock()

    def close(self) -> None:
        """End the compiling process, and wait for the thread; `on_done` is not called any more.

        Not for one that compiles in this process, where no folder can keep the code.
        """
        with self._lock:
            self._is_closed = True
            if self._compiler is not None:
                self._compiler.kill()
        self.join(JOIN_TIMEOUT)

    def run(self) -> None:
        """Make it."""
        start = time.monotonic()
        try:
            # It declares the compiled functions: then it is known which of them are on disk.
            import gp_ground_seg.core.compiled.backend  # noqa: F401
            from gp_ground_seg.core.jit import code_folder, is_code_kept
            from gp_ground_seg.core.segmenter import warm_up

            if code_folder() is not None and not is_code_kept():
                self._compile()
            if not self._is_closed:
                # Not with a given height: the scan that is segmented here has another.
                config = dataclasses.replace(self._config, sensor=Config().sensor)
                self.backend = warm_up(config)
        except Exception as error:
            self.error = f'{type(error).__name__}: {error}'
        self.seconds = time.monotonic() - start
        with self._lock:
            if not self._is_closed:
                self.is_done = True
                self._on_done()

    def _compile(self) -> None:
        """Compile in a child process, whose memory is free after it: twice what the node needs."""
        with self._lock:
            if self._is_closed:
                return
            self._compiler = subprocess.Popen(
                child_command(_COMPILE),
                cwd='/',
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
            )
        with self._compiler:
            assert self._compiler.stderr is not None
            said = self._compiler.stderr.read().decode(errors='replace').strip()
            code = self._compiler.wait()
        if code and not self._is_closed:
            reason = said.splitlines()[-1] if said else f'exit code {code}'
            raise RuntimeError(f'the compiling process failed: {reason}')
