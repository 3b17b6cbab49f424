"""Blocks of items, computed in this process or by a Dask cluster.

The one module that imports dask and distributed, optional packages.
"""

from __future__ import annotations

import asyncio
import copy
import importlib.metadata
import itertools
import logging
import multiprocessing
import os
import platform
import resource
import signal
import sys
import threading
import uuid
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

from tqdm import tqdm

import gp_ground_seg
from gp_ground_seg.core import log
from gp_ground_seg.core.errors import DataError, in_one_line, require

_LOGGER = logging.getLogger('gp_ground_seg')
BLOCK_SIZE = 64
"""Items of a block, where there are enough for all workers: they share what a task costs."""
_CONFIG: dict[str, Any] = {
    'distributed.admin.tick.limit': '1h',  # it warns where a process had to wait
    'distributed.comm.timeouts.connect': '10s',
    # A worker that died and takes its time to start anew is not given up.
    'distributed.deploy.lost-worker-timeout': '1h',
    # Dask's workers return freed memory to the system at once, and fetch it anew for each frame:
    # a quarter of a frame's time.
    'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': None,
    'distributed.worker.profile.enabled': False,  # samples the stack 100 times a second
    # Pages about the work for everyone on the machine, without a password.
    'distributed.scheduler.http.routes': [],
    'distributed.worker.http.routes': [],
}

_NO_BAR = partial(tqdm, disable=True)
Progress = Callable[[Sequence[Any]], Iterable[Any]]
"""Wraps items to show how far the work is, as tqdm does."""
Function = Callable[[Sequence[Any], Progress], Any]
"""Computes a block of items; a module's function or a `partial` of one, to be sent to workers."""


class Runner:
    """Computes blocks of items; by default one after the other, in this process.

    Parameters
    ----------
    bar : callable
        Makes the progress bar of a number of items, ``bar(total=n)``.
    client : distributed.Client, optional
        Of the cluster whose workers compute the blocks.
    """

    def __init__(self, bar: Callable[..., tqdm[Any]] = _NO_BAR, client: Any = None) -> None:
        self._bar, self._client = bar, client

    @property
    def n_workers(self) -> int:
        """Threads of the cluster's workers; 0 in this process."""
        return sum(self._client.nthreads().values()) if self._client is not None else 0

    def run(
        self,
        function: Function,
        items: Sequence[Any],
        group: Callable[[Any], Hashable] | None = None,
    ) -> list[Any]:
        """Return what `function` makes of each block of the items, in their order.

        In this process they are one block; else `group` is as in `cut`.
        """
        on_cluster = self._client is not None
        blocks = cut(items, group, self.n_workers) if on_cluster else [items]
        found = dict(self.map_blocks(function, blocks))
        return [found[k] for k in range(len(blocks))]

    def map_blocks(
        self, function: Function, blocks: Sequence[Sequence[Any]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the number of each block and what `function` makes of it, as they are finished.

        A block whose worker dies is computed again by another, and a warning says so. Raises what
        `function` raises.
        """
        with self._bar(total=sum(map(len, blocks))) as bar:
            if self._client is None:
                for k, block in enumerate(blocks):
                    yield k, function(block, partial(_count, bar))
                return
            for k, found in self._submit(partial(_compute, _versions(), function), blocks):
                bar.update(len(blocks[k]))
                yield k, found

    def _submit(
        self, compute: Callable[..., Any], blocks: Sequence[Sequence[Any]]
    ) -> Iterator[tuple[int, Any]]:
        from distributed import as_completed

        run, said = f'gp_ground_seg-{uuid.uuid4().hex}', set()
        if not self.n_workers:
            _LOGGER.warning('the scheduler has no worker yet, waiting for one')

        self._client.subscribe_topic('all', partial(_tell_loss, run))
        try:
            # A list of futures that is kept would keep their results on the cluster.
            finished = as_completed(
                [
                    self._client.submit(compute, block, key=(run, k), pure=False)
                    for k, block in enumerate(blocks)
                ],
                loop=self._client.loop,
            )
            for future in finished:
                k = future.key[1]
                found, notes = _result(future, blocks[k])
                for level, line in notes:
                    if line not in said:
                        said.add(line)
                        _LOGGER.log(level, '%s', line)
                yield k, found
        finally:
            self._client.unsubscribe_topic('all')


HERE = Runner()
"""In this process, without a bar."""


def _count(bar: tqdm[Any], items: Iterable[Any]) -> Iterator[Any]:
    for item in items:
        yield item
        bar.update()


def _result(future: Any, block: Sequence[Any]) -> tuple[Any, list[tuple[int, str]]]:
    """Return what `_compute` returned for a block; DataError where the cluster failed."""
    from distributed import KilledWorker

    try:
        found: tuple[Any, list[tuple[int, str]]] = future.result()
    except KilledWorker as error:
        raise DataError(
            f'{block[0]} to {block[-1]}: each worker that computed this block died, as where '
            'memory is short; fewer --workers have more of it each'
        ) from error
    except (CancelledError, OSError, RuntimeError) as error:  # RuntimeError: no further thread
        if future.status == 'error':  # raised by the function
            raise
        raise DataError(f'the scheduler is lost ({error})') from error
    return found


def _tell_loss(run: str, event: tuple[float, Any]) -> None:
    """Log the blocks of a run that a worker was computing when it died."""
    _, about = event
    if isinstance(about, dict) and about.get('action') == 'remove-worker':
        keys = [*about['processing-tasks'], *about.get('lost-computed-tasks', ())]
        lost = sorted(key[1] for key in keys if key[0] == run)
        if lost and not about['expected']:
            numbers = ', '.join(map(str, lost))
            _LOGGER.warning('worker %s died; computed again: block %s', about['worker'], numbers)


def cut(
    items: Sequence[Any], group: Callable[[Any], Hashable] | None, n_workers: int = 1
) -> list[list[Any]]:
    """Cut items into blocks, in their order.

    With `group` a block is all items of one group, which follow one another; else it has
    `BLOCK_SIZE` items, or fewer if there would not be two for each worker.
    """
    if group is not None:
        return [[*members] for _, members in itertools.groupby(items, key=group)]
    size = max(1, min(BLOCK_SIZE, -(-len(items) // (2 * max(1, n_workers)))))
    return [[*items[k : k + size]] for k in range(0, len(items), size)]


def package_versions(*packages: str) -> dict[str, str | None]:
    """Versions of what labels depend on, and of further `packages`; None: not installed."""
    versions: dict[str, str | None] = {'gp_ground_seg': gp_ground_seg.__version__}
    for package in ('numpy', 'scipy', 'numba', *packages):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return versions


def _versions() -> dict[str, str | None]:
    """Versions of what labels depend on."""
    return {**package_versions(), 'Python': platform.python_version()}


def _compute(
    expected: dict[str, str | None], function: Function, block: Sequence[Any]
) -> tuple[Any, list[tuple[int, str]]]:
    """Compute a block in a worker; return the result and what the library logged meanwhile."""
    here, notes = _versions(), list[tuple[int, str]]()
    other = [
        f'{name} {v}, not {expected[name]}' for name, v in here.items() if v != expected[name]
    ]
    if here['gp_ground_seg'] != expected['gp_ground_seg']:
        raise DataError(f'a worker on {platform.node()} has {"; ".join(other)}')
    if other:
        line = f'a worker on {platform.node()} has {"; ".join(other)}: last digits may differ'
        notes.append((logging.WARNING, line))
    with log.passed_to(lambda *message: notes.append(message)):
        return function(block, iter), notes


@contextmanager
def _interrupt_kept() -> Iterator[None]:
    """Keep Ctrl-C, which all processes of a terminal get, from those that are started.

    They inherit the mask of signals. Here it takes effect when they are started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    # Starts the resource tracker of multiprocessing, which changes the mask of this thread.
    multiprocessing.get_context('spawn').Lock()
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def open_runner(
    workers: int | None, scheduler: str | None, bar: Callable[..., tqdm[Any]]
) -> Iterator[Runner]:
    """Runner on `workers` processes of this machine, on the cluster of a scheduler, or neither.

    Raises DataError if the scheduler does not answer, MissingDependencyError without distributed.
    """
    with ExitStack() as stack:
        client = None
        with _interrupt_kept():
            if scheduler is not None:
                client = stack.enter_context(_connect(scheduler))
                _LOGGER.info('dashboard: %s', client.dashboard_link)
            elif workers is not None:
                client = stack.enter_context(_start(workers, stack))
        yield Runner(bar, client)


def _start(n_workers: int, stack: ExitStack) -> Any:
    """Start workers of one thread on this machine, for this process alone; return their client.

    They run what reaches their ports, as does the scheduler, and every user of the machine reaches
    these: TLS with a key of this run keeps others out. Their files are in a private folder, gone
    afterwards: Dask's own is at a known place in /tmp, where others can plant links, and modules,
    as Dask imports from there.
    """
    distributed = _distributed()
    require('cryptography', 'cryptography')
    most = 4 * (os.cpu_count() or 1)
    if n_workers > most:
        raise DataError(
            f'--workers {n_workers}: must be 1 to {most} here, four for each processor'
        )
    n_files, needed = resource.getrlimit(resource.RLIMIT_NOFILE)[0], 64 + 16 * n_workers
    if n_files < needed:  # Dask may wait forever
        raise DataError(
            f'--workers {n_workers}: needs {needed} open files, the limit is {n_files} (ulimit -n)'
        )
    try:
        with _silent():
            folder = stack.enter_context(TemporaryDirectory(prefix='gp_ground_seg-'))
            config = require('dask.config', 'distributed').set({'temporary-directory': folder})
            stack.enter_context(config)
            cluster = distributed.LocalCluster(
                n_workers=n_workers, threads_per_worker=1,
                security=distributed.Security.temporary(),
                dashboard_address='127.0.0.1:0', scheduler_kwargs={'dashboard': False},
                silence_logs=logging.CRITICAL,
            )  # fmt: skip
            return distributed.Client(stack.enter_context(cluster), set_as_default=False)
    except Exception as error:  # of any type: what was not ready fails again while it is closed
        first: BaseException = error
        while before := first.__cause__ or first.__context__:
            first = before
        raise DataError(
            f'--workers {n_workers}: Dask cannot start here ({in_one_line(first)}); '
            'fewer workers take less memory'
        ) from error


@contextmanager
def _silent() -> Iterator[None]:
    """Drop what this process and those that it starts in the block print on standard error.

    Dask's event loop and a worker that dies while it starts print tracebacks there.
    """
    sys.stderr.flush()
    with open(os.devnull, 'wb') as nothing, os.fdopen(os.dup(2), 'wb') as before:
        os.dup2(nothing.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(before.fileno(), 2)


def _connect(address: str) -> Any:
    if not address.startswith(('tcp://', 'tls://')):
        raise DataError(f'--scheduler {address}: must be tcp://HOST:PORT, or tls://')
    distributed = _distributed()
    try:
        # A client that cannot connect is left half made: it closes when it is collected, and where
        # that falls into the start of the next one, both wait for one lock for ever.
        asyncio.run(_greet(address))
        with warnings.catch_warnings():
            # Versions are compared by `_compute`, which says in one line what differs.
            warnings.simplefilter('ignore', distributed.versions.VersionMismatchWarning)
            return distributed.Client(address, set_as_default=False)
    except (OSError, ValueError, TypeError, MemoryError) as error:  # memory: no Dask speaks there
        raise DataError(f'--scheduler {address}: does not answer ({error})') from error


async def _greet(address: str) -> None:
    """Connect to a scheduler with the keys of Dask's configuration, and hang up."""
    from distributed import Security
    from distributed.comm import connect

    comm = await connect(address, **Security().get_connection_args('client'))
    await comm.close()


def _distributed() -> Any:
    """Import distributed; it says nothing but by way of what we do."""
    distributed = require('distributed', 'distributed')
    # A copy, as Dask adds to the lists that it is given.
    require('dask.config', 'distributed').set(copy.deepcopy(_CONFIG))
    for name in ('distributed', 'distributed.client'):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return distributed
