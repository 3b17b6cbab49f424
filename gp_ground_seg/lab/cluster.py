"""Blocks of items, computed in this process or by Dask: on this machine, or on a cluster.

The one module that imports distributed, an optional package.
"""

from __future__ import annotations

import itertools
import logging
import multiprocessing
import os
import platform
import signal
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from typing import Any

from tqdm import tqdm

from gp_ground_seg import __version__
from gp_ground_seg.core import errors
from gp_ground_seg.core.errors import DataError, require

BLOCK_SIZE = 64
"""Items of a block, where there are enough for all workers: they share what a task costs."""
CONNECT_TIMEOUT = 10
"""Time in which a scheduler must answer [s]."""
PACKAGES = 'distributed cryptography'
"""What both kinds of workers need, of PyPI."""

_NO_BAR = partial(tqdm, disable=True)
Progress = Callable[[Iterable[Any]], Iterable[Any]]
"""Wraps items, once, to show how far the work is, as tqdm does."""
Function = Callable[[Sequence[Any], Progress], Any]
"""Computes a block of items; a module's function or a `partial` of one, to be sent to workers."""
_Notes = list[tuple[int, str]]  # what the library logs: severity and text


@dataclass(frozen=True)
class Runner:
    """Computes blocks of items; by default one after the other, in this process."""

    bar: Callable[..., tqdm[Any]] = _NO_BAR  # makes a progress bar, as tqdm does
    client: Any = None  # distributed.Client of the cluster that computes the blocks
    n_workers: int = 0  # how many there are; 0 in this process

    def run(
        self,
        function: Function,
        items: Sequence[Any],
        group: Callable[[Any], Hashable] | None = None,
    ) -> list[Any]:
        """Return what `function` makes of each block of the items, in their order.

        In this process they are one block; else `group` is as in `cut`. A block whose worker dies
        is computed again. Raises what `function` raises, and DataError if every worker that
        computes a block dies, or the scheduler is lost.
        """
        if self.client is None:
            return [function(items, partial(self.bar, total=len(items)))]
        from distributed import KilledWorker, as_completed

        blocks = cut(items, group, self.n_workers)
        compute = partial(_compute_block, __version__, function)
        futures = self.client.map(compute, blocks, pure=False)
        block_of, found = dict(zip(futures, blocks, strict=True)), {}
        with self.bar(total=len(items)) as bar:
            for future in as_completed(futures, loop=self.client.loop):
                block = block_of[future]
                try:
                    found[future], notes = future.result()
                except CancelledError as error:
                    raise DataError('the scheduler is lost') from error
                except KilledWorker as error:
                    raise DataError(
                        f'{block[0]} to {block[-1]}: each worker that computed this block died, '
                        'as where memory is short: fewer workers have more of it each'
                    ) from error
                for note in notes:
                    errors.log_once(*note)
                bar.update(len(block))
        return [found[future] for future in futures]


HERE = Runner()
"""In this process, without a bar."""


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


def _compute_block(version: str, function: Function, block: Sequence[Any]) -> tuple[Any, _Notes]:
    """Compute a block in a worker; return the result and what the library logged meanwhile."""
    if version != __version__:
        raise DataError(
            f'a worker on {platform.node()} has gp_ground_seg {__version__}, not {version}'
        )
    notes = _Notes()
    with errors.messages_passed_to(lambda *message: notes.append(message)):
        return function(block, iter), notes


@contextmanager
def open_runner(
    workers: int | None, scheduler: str | None, bar: Callable[..., tqdm[Any]]
) -> Iterator[Runner]:
    """Runner on `workers` processes of this machine, on the cluster of a scheduler, or neither.

    Raises DataError if the scheduler does not answer, MissingDependencyError without distributed.
    """
    if scheduler is not None:
        distributed = _quiet_distributed()
        try:  # with the keys of Dask's configuration
            # A client of an address that cannot be one would wait 20 s for its own end.
            distributed.comm.parse_host_port(distributed.comm.parse_address(scheduler)[1])
            client = distributed.Client(scheduler, set_as_default=False, timeout=CONNECT_TIMEOUT)
        except (OSError, ValueError, TypeError, MemoryError) as error:  # memory: no Dask is there
            said = f'does not answer ({errors.in_one_line(error)})'
            raise DataError(f'--scheduler {scheduler}: {said}') from error
        with client:
            errors.LOGGER.info('dashboard: %s', client.dashboard_link)
            n_workers = sum(client.nthreads().values())
            if not n_workers:
                errors.LOGGER.warning('the scheduler has no worker yet, waiting for one')
            yield Runner(bar, client, n_workers)
    elif workers is not None:
        if workers > (most := 4 * (os.cpu_count() or 1)):
            raise DataError(f'--workers {workers}: more than {most}, four for each processor')
        with _start_workers(workers) as client:
            yield Runner(bar, client, workers)
    else:
        yield Runner(bar)


def _quiet_distributed() -> Any:
    """Import distributed; what it would log is said here in one line."""
    distributed = require('distributed', PACKAGES)
    for name in 'distributed', 'distributed.client':
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return distributed


@contextmanager
def _start_workers(n_workers: int) -> Iterator[Any]:
    """Start a Dask cluster on this machine, which ends with the block."""
    distributed, dask = _quiet_distributed(), require('dask', PACKAGES)
    require('cryptography', PACKAGES)
    others = multiprocessing.active_children()
    settings: dict[str, Any] = {
        # Without the pages that would show others on this machine what is computed.
        'distributed.scheduler.http.routes': (),
        'distributed.worker.http.routes': (),
        # Nor with settings of malloc, which would take the memory of each frame from the system.
        'distributed.nanny.pre-spawn-environ': {},
    }
    with dask.config.set(settings):
        # Ctrl-C, which all processes of a terminal get, is kept from those of threads started
        # here, which inherit the mask of signals; in this process it takes effect behind them.
        resource_tracker.ensure_running()  # its start would change the mask
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            cluster = distributed.LocalCluster(
                n_workers=0,  # they start below: Ctrl-C does not wait for them
                threads_per_worker=1,
                memory_limit=None,
                host='127.0.0.1',
                security=distributed.Security.temporary(),
                scheduler_kwargs={'dashboard': False, 'dashboard_address': '127.0.0.1:0'},
                silence_logs=logging.CRITICAL,
            )
            client = distributed.Client(cluster, set_as_default=False)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with cluster, client:
            try:
                cluster.scale(n_workers)
                yield client
            except BaseException:
                # Without waiting for the blocks that are computed, and for workers that start.
                for worker in cluster.workers.values():
                    worker.close_gracefully()  # or it would start the process anew
                for process in {*multiprocessing.active_children()} - {*others}:
                    process.kill()
                raise
