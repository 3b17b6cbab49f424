"""Parts of the work: every item once, errors passed on, one thread where none can start."""

import os
import threading
import time
from concurrent.futures import Future
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.core.compiled import threads
from gp_ground_seg.core.compiled.backend import NumbaBackend
from gp_ground_seg.core.compiled.threads import (
    POINTS_TO_SORT,
    SEGMENTS_TO_GROW,
    Part,
    Workers,
    run_of,
)
from gp_ground_seg.core.frame import GroundSurface


@pytest.fixture
def workers():
    with patch.object(threads, 'JIT_ENABLED', True):
        workers = Workers(3)
    yield workers
    workers.close()


@given(st.integers(0, 1000), st.integers(1, 9))
def test_runs_of_points_hold_every_point_once(n, n_parts):
    runs = [run_of(Part(number, n_parts), n) for number in range(n_parts)]
    assert [i for run in runs for i in range(n)[run]] == list(range(n))
    sizes = [run.stop - run.start for run in runs]
    assert max(sizes) - min(sizes) <= 1


def test_each_part_runs_once_and_in_threads(workers):
    seen, names = np.zeros(1000), set()
    barrier = threading.Barrier(3, timeout=30)

    def work(part, seen):
        barrier.wait()  # only if all three run at the same time
        seen[run_of(part, 1000)] += 1
        names.add(threading.current_thread().name)

    for _ in range(20):
        workers.run(work, 3, seen)
    assert (seen == 20).all()
    assert len(names) == 3


@pytest.mark.parametrize('failing', [0, 1, 2])
def test_an_error_is_raised_after_all_parts_have_ended(workers, failing):
    ended = []

    def work(part):
        if part.number == failing:
            raise ValueError('that part')
        time.sleep(0.05)
        ended.append(part.number)

    with pytest.raises(ValueError, match='that part'):
        workers.run(work, 3)
    assert sorted(ended) == sorted({0, 1, 2} - {failing})


def test_an_interrupted_wait_leaves_the_next_frame_other_buffers():
    may_end = threading.Event()

    def work(part):
        if part.number == 0:
            raise KeyboardInterrupt
        may_end.wait(30)

    with patch.object(threads, 'JIT_ENABLED', True):
        backend = NumbaBackend(2)
    points = np.random.default_rng(0).uniform(-30.0, 30.0, (5000, 3)).astype(np.float32)
    before = backend.build_grid(points, Config())
    assert np.shares_memory(before.xyz, backend.build_grid(points, Config()).xyz)
    assert backend.workers.is_idle
    busy = backend.workers
    with (
        patch.object(Future, 'exception', side_effect=KeyboardInterrupt),
        pytest.raises(KeyboardInterrupt),
    ):
        busy.run(work, 2)
    try:
        assert not busy.is_idle
        after = backend.build_grid(points, Config())
        assert backend.workers is not busy
        assert not np.shares_memory(before.xyz, after.xyz)
        np.testing.assert_array_equal(before.xyz, after.xyz)
    finally:
        may_end.set()
        busy.close()
        backend.close()


@pytest.mark.parametrize('n_started', [0, 1])
def test_one_thread_does_it_where_none_can_be_started(workers, n_started):
    real, started = threading.Thread.start, []

    def start(thread):
        if len(started) == n_started:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        real(thread)

    seen = []
    with patch.object(threading.Thread, 'start', start):
        workers.run(lambda part: seen.append(part.number), 3)
    assert seen == [0, 1, 2]
    assert workers.n_threads == 1
    for thread in started:
        thread.join(30)
        assert not thread.is_alive()


def test_number_of_threads():
    with patch.object(threads, 'JIT_ENABLED', True):
        for n_cores, expected in ((1, 1), (2, 2), (64, threads.DEFAULT_MAX_THREADS)):
            with patch.object(os, 'sched_getaffinity', lambda pid, n=n_cores: set(range(n))):
                assert Workers(0).n_threads == expected
        assert Workers(7).n_threads == 7
    with patch.object(threads, 'JIT_ENABLED', False):
        assert Workers(7).n_threads == 1


def test_little_work_is_not_split(workers):
    """Learning looks at 6 segments again and again; a hand-over takes longer than they do."""
    assert [workers.n_parts(n, SEGMENTS_TO_GROW) for n in (0, 1, 45, 119, 120, 180, 2048)] == [
        1, 1, 1, 1, 2, 3, 3
    ]  # fmt: skip


def test_points_of_small_clouds_are_not_split_and_threads_end_and_start_again():
    with patch.object(threads, 'JIT_ENABLED', True):
        backend = NumbaBackend(3)
    points = np.random.default_rng(0).uniform(-30.0, 30.0, (3 * POINTS_TO_SORT, 3))
    config, before = Config(), threading.active_count()
    for n_points, n_started in ((POINTS_TO_SORT, 0), (len(points), 2), (len(points), 2)):
        scan = backend.build_grid(points[:n_points], config)
        flat = np.zeros((config.grid.n_segments, len(scan.grid.edges)))
        surface = GroundSurface(scan.grid.edges, flat, flat, np.ones(0, dtype=bool))
        backend.label_points(scan, backend.find_faces(scan, config), surface, config)
        assert threading.active_count() == before + n_started
        backend.close()
        assert threading.active_count() == before
