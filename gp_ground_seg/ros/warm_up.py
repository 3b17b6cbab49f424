"""The compiled backend, made beside the running node; and what the library logs meanwhile."""

from __future__ import annotations

import dataclasses
import importlib
import subprocess
import threading
import time
from collections.abc import Callable

from gp_ground_seg.core.backend import Backend
from gp_ground_seg.core.jit import code_folder, is_code_kept
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.segmenter import warm_up
from gp_ground_seg.ros.start_stop import child_command

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
                child_command(_COMPILE), cwd='/', stdin=pipe, stdout=nowhere, stderr=pipe
            )
        with self._compiler:
            assert self._compiler.stderr is not None
            said = self._compiler.stderr.read().decode(errors='replace').strip()
            code = self._compiler.wait()
        if code and not self._is_stopped:
            reason = said.splitlines()[-1] if said else f'exit code {code}'
            raise RuntimeError(f'the compiling process failed: {reason}')
