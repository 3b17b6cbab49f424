"""Blocks of items, computed here, in processes of this machine, or by a Dask cluster.

The one module that imports distributed, an optional package.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import itertools
import logging
import multiprocessing
import os
import platform
import signal
import threading
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
)
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from queue import SimpleQueue
from typing import Any

from tqdm import tqdm

import gp_ground_seg
from gp_ground_seg.core.errors import LOGGER, DataError, in_one_line, messages_passed_to, require

BLOCK_SIZE = 64
"""Items of a block, where there are enough for all workers: they share what a task costs."""
MAX_RESTARTS = 3
"""How often workers of this machine are started anew, if one of them dies."""
CONNECT_TIMEOUT = 10
"""Time in which a scheduler must answer [s]."""

_NO_BAR = partial(tqdm, disable=True)
Progress = Callable[[Iterable[Any]], Iterable[Any]]
"""Wraps items to show how far the work is, as tqdm does."""
Function = Callable[[Sequence[Any], Progress], Any]
"""Computes a block of items; a module's function or a `partial` of one, to be sent to workers."""
_Notes = list[tuple[int, str]]  # what the library logs: severity and text


class Runner:
    """Computes blocks of items; by default one after the other, in this process.

    Parameters
    ----------
    bar : callable
        Makes the progress bar of a number of items, ``bar(total=n)``.
    open_executor : callable, optional
        Opens workers that compute the blocks, as a context.
    n_workers : int
        How many there are; 0 in this process.
    """

    def __init__(
        self,
        bar: Callable[..., tqdm[Any]] = _NO_BAR,
        open_executor: Callable[[], AbstractContextManager[Executor]] | None = None,
        n_workers: int = 0,
    ) -> None:
        self._bar, self._open_executor, self.n_workers = bar, open_executor, n_workers

    def run(
        self,
        function: Function,
        items: Sequence[Any],
        group: Callable[[Any], Hashable] | None = None,
    ) -> list[Any]:
        """Return what `function` makes of each block of the items, in their order.

        In this process they are one block; else `group` is as in `cut`.
        """
        is_here = self._open_executor is None
        return [*self.map(function, [items] if is_here else cut(items, group, self.n_workers))]

    def map(
        self,
        function: Function,
        blocks: Sequence[Sequence[Any]],
        size_of: Callable[[Sequence[Any]], int] = len,
    ) -> Iterator[Any]:
        """Yield what `function` makes of each block, in their order; the bar is of their sizes.

        A block whose worker dies is computed again. Raises what `function` raises, and DataError
        if workers die again and again.
        """
        with self._bar(total=sum(map(size_of, blocks))) as bar:
            if self._open_executor is None:
                for block in blocks:
                    yield function(block, partial(_count, bar))
                return
            found, n_yielded = dict[int, Any](), 0
            for k, result in self._compute(function, dict(enumerate(blocks))):
                bar.update(size_of(blocks[k]))
                found[k] = result
                while n_yielded in found:
                    yield found.pop(n_yielded)
                    n_yielded += 1

    def _compute(
        self, function: Function, left: dict[int, Sequence[Any]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the number and the result of each block when it is finished."""
        assert self._open_executor is not None
        said = set[str]()
        for n_restarts in itertools.count():
            with self._open_executor() as executor:
                for k, (result, notes) in _completed(executor, function, left):
                    del left[k]
                    for level, line in notes:
                        if line not in said:
                            said.add(line)
                            LOGGER.log(level, '%s', line)
                    yield k, result
            if not left:
                return
            if n_restarts == MAX_RESTARTS:
                first = next(iter(left.values()))[0]
                raise DataError(
                    f'workers died {n_restarts + 1} times, as where memory is short: fewer '
                    f'--workers have more of it each; the first item that is left is {first}'
                )
            LOGGER.warning('a worker died; computed again: %d blocks', len(left))


HERE = Runner()
"""In this process, without a bar."""


def _count(bar: tqdm[Any], items: Iterable[Any]) -> Iterator[Any]:
    for item in items:
        yield item
        bar.update()


def _completed(
    executor: Executor, function: Function, blocks: dict[int, Sequence[Any]]
) -> Iterator[tuple[int, tuple[Any, _Notes]]]:
    """Yield the number of each block and what `_compute_block` returns, when it is finished.

    Those of processes that died are left out. Raises DataError if the cluster fails.
    """
    compute = partial(_compute_block, _versions(), function)
    futures: dict[Future[tuple[Any, _Notes]], int] = {}
    # Not `as_completed`: it locks all futures by turns, and where Ctrl-C comes between two of them
    # they stay locked, so that the executor, which sets their results, never ends.
    finished = SimpleQueue[Future[tuple[Any, _Notes]]]()
    with _ctrl_c_kept(), suppress(BrokenExecutor):  # processes start here, and may die here
        for k, block in blocks.items():
            future = executor.submit(compute, block)
            futures[future] = k
            future.add_done_callback(finished.put)
    while futures:
        future = finished.get()
        k = futures.pop(future)  # or the cluster would keep the result
        try:
            yield k, future.result()
        except BrokenExecutor:
            continue
        except CancelledError as error:
            raise DataError('the scheduler is lost') from error
        except Exception as error:
            if type(error).__name__ != 'KilledWorker':  # of distributed, which may be missing
                raise
            first, last = blocks[k][0], blocks[k][-1]
            raise DataError(
                f'{first} to {last}: each worker that computed this block died, as where memory '
                'is short'
            ) from error


@contextmanager
def _ctrl_c_kept() -> Iterator[None]:
    """Keep Ctrl-C, which all processes of a terminal get, from those that are started.

    They inherit the mask of signals. Here it takes effect when they are started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    resource_tracker.ensure_running()  # its start would change the mask
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


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


def _compute_block(
    expected: dict[str, str | None], function: Function, block: Sequence[Any]
) -> tuple[Any, _Notes]:
    """Compute a block in a worker; return the result and what the library logged meanwhile."""
    here, notes = _versions(), _Notes()
    other = [
        f'{name} {v}, not {expected[name]}' for name, v in here.items() if v != expected[name]
    ]
    if here['gp_ground_seg'] != expected['gp_ground_seg']:
        raise DataError(f'a worker on {platform.node()} has {"; ".join(other)}')
    if other:
        line = f'a worker on {platform.node()} has {"; ".join(other)}: last digits may differ'
        notes.append((logging.WARNING, line))
    with messages_passed_to(lambda *message: notes.append(message)):
        return function(block, iter), notes


@contextmanager
def open_runner(
    workers: int | None, scheduler: str | None, bar: Callable[..., tqdm[Any]]
) -> Iterator[Runner]:
    """Runner on `workers` processes of this machine, on the cluster of a scheduler, or neither.

    Raises DataError if the scheduler does not answer, MissingDependencyError without distributed.
    """
    if scheduler is not None:
        with _connect(scheduler) as client:
            LOGGER.info('dashboard: %s', client.dashboard_link)
            n_workers = sum(client.nthreads().values())
            if not n_workers:
                LOGGER.warning('the scheduler has no worker yet, waiting for one')
            yield Runner(bar, partial(_tasks, client), n_workers)
    elif workers is not None:
        most = 4 * (os.cpu_count() or 1)
        if workers > most:
            raise DataError(
                f'--workers {workers}: must be 1 to {most} here, four for each processor'
            )
        yield Runner(bar, partial(_processes, workers), workers)
    else:
        yield Runner(bar)


@contextmanager
def _processes(n_workers: int) -> Iterator[Executor]:
    """Start processes when there is work, and end them, at once if the block fails.

    They are spawned: a fork of a process with threads, as of numba or BLAS, may hang.
    """
    context, others = multiprocessing.get_context('spawn'), multiprocessing.active_children()
    executor = ProcessPoolExecutor(n_workers, context, _end_with_parent)
    try:
        yield executor
    except BaseException:
        for process in multiprocessing.active_children():
            if process not in others:
                process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """End this process when the one that started it ends, in whatever way."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


@contextmanager
def _tasks(client: Any) -> Iterator[Executor]:
    """Submit to a Dask cluster, and cancel what is left if the block fails."""
    executor = client.get_executor(pure=False)
    try:
        yield executor
    finally:
        executor.shutdown(wait=False)


def _connect(address: str) -> Any:
    """Connect to a scheduler, with the keys of Dask's configuration."""
    if not address.startswith(('tcp://', 'tls://')):
        raise DataError(f'--scheduler {address}: must be tcp://HOST:PORT, or tls://')
    distributed = require('distributed', 'distributed')
    for name in ('distributed', 'distributed.client'):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # said here in one line
    try:
        # A client that cannot connect is left half made: it closes when it is collected, and where
        # that falls into the start of the next one, both wait for one lock for ever.
        asyncio.run(_greet(address))
        with warnings.catch_warnings():
            # Versions are compared by `_compute_block`, which says in one line what differs.
            warnings.simplefilter('ignore', distributed.versions.VersionMismatchWarning)
            return distributed.Client(address, set_as_default=False)
    except (OSError, ValueError, TypeError, MemoryError) as error:  # memory: no Dask speaks there
        text = f'--scheduler {address}: does not answer ({in_one_line(error)})'
        raise DataError(text) from error


async def _greet(address: str) -> None:
    """Connect to a scheduler with the keys of Dask's configuration, and hang up."""
    from distributed import Security
    from distributed.comm import connect

    keys = Security().get_connection_args('client')
    comm = await connect(address, timeout=CONNECT_TIMEOUT, **keys)
    await comm.close()
