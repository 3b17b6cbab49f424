"""Threads of a pool keep off the core of the thread that they work for."""

import os
import threading

import numpy as np
import pytest

from gp_ground_seg.compiled.cores import OutOfTheWay, own_core, usable_cores
from gp_ground_seg.compiled.meeting import all_done, claim, enlist
from gp_ground_seg.compiled.parallel import RowPool
from gp_ground_seg.jit import compiled


@pytest.fixture
def own_affinity():
    """Cores of this thread, as they were before and are to be after."""
    before = os.sched_getaffinity(0)
    yield before
    os.sched_setaffinity(0, before)


@compiled
def count(share, n_shares, board, seen):
    share = enlist(board, share, n_shares)
    stage = np.int64(0)
    block = claim(board, stage, share, n_shares, len(seen))
    while block >= 0:
        seen[block] += 1
        block = claim(board, stage, share, n_shares, len(seen))
    all_done(board, stage, share, n_shares, len(seen))


def test_a_thread_knows_its_core(own_affinity):
    for core in own_affinity:
        os.sched_setaffinity(0, {core})
        assert own_core() == core
        assert usable_cores() == {core}


def test_workers_use_any_core_but_that_of_the_caller(monkeypatch):
    given = {}
    monkeypatch.setattr('gp_ground_seg.compiled.cores.usable_cores', lambda: {0, 1, 2, 5})
    monkeypatch.setattr(
        os, 'sched_setaffinity', lambda thread, cores: given.update({thread: cores})
    )
    own = threading.current_thread()
    away = OutOfTheWay([own])
    for core, others in ((1, {0, 2, 5}), (5, {0, 1, 2})):
        monkeypatch.setattr('gp_ground_seg.compiled.cores.own_core', lambda core=core: core)
        away.leave_own_core()
        assert given == {own.native_id: others}
        given.clear()
        away.leave_own_core()
        assert not given, 'they are there already'


@pytest.mark.parametrize('cores', [{3}, {3, 4}])
def test_nobody_moves_together_for_one_who_wants_a_core_alone(monkeypatch, cores):
    given = []
    monkeypatch.setattr('gp_ground_seg.compiled.cores.usable_cores', lambda: cores)
    monkeypatch.setattr('gp_ground_seg.compiled.cores.own_core', lambda: 3)
    monkeypatch.setattr(os, 'sched_setaffinity', lambda *call: given.append(call))
    OutOfTheWay([threading.current_thread()] * 2).leave_own_core()
    assert not given


def test_threads_that_are_gone_are_let_be(monkeypatch):
    """As in a forked process: the threads by those numbers are its parent's."""
    given = []
    monkeypatch.setattr('gp_ground_seg.compiled.cores.usable_cores', lambda: {0, 1, 2, 5})
    monkeypatch.setattr(os, 'sched_setaffinity', lambda *call: given.append(call))
    gone = threading.Thread(target=str)
    gone.start()
    gone.join()
    OutOfTheWay([gone]).leave_own_core()
    assert not given


def test_work_goes_on_where_threads_cannot_be_moved(monkeypatch):
    def refuse(thread, cores):
        raise PermissionError(1, 'Operation not permitted')

    pool = RowPool(2)
    monkeypatch.setattr(os, 'sched_setaffinity', refuse)
    seen = np.zeros(40)
    pool.run(count, 2, seen)
    np.testing.assert_array_equal(seen, 1)
    pool.close()


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason='there is one core for all')
def test_real_workers_are_moved_off_and_the_caller_never(own_affinity):
    before = set(threading.enumerate())
    pool = RowPool(2)
    pool.team(2)
    (worker,) = set(threading.enumerate()) - before
    for _ in range(20):
        pool.run(count, 2, np.zeros(40))
        cores = os.sched_getaffinity(worker.native_id)
        assert len(own_affinity - cores) == 1
        assert os.sched_getaffinity(0) == own_affinity
    pool.close()
