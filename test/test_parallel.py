"""Shares of work in threads: all done, errors passed on, threads gone in the end."""

import gc
import threading
import time

import pytest

from gp_ground_seg.parallel import FEWEST_POINTS, MOST_UNASKED, RowPool


@pytest.fixture
def pool():
    pool = RowPool(3)
    yield pool
    pool.close()


def test_every_row_is_done_once_whatever_the_number_of_threads():
    for n_threads in (1, 2, 3, 7):
        pool = RowPool(n_threads)
        for n_rows in (0, 1, 5, FEWEST_POINTS, 3 * FEWEST_POINTS + 1):
            rows, points, shares = [], [], []
            pool.run(lambda a, b, step, to: to.extend(range(a, b, step)), n_rows, rows)
            pool.run_points(lambda a, b, to: to.extend(range(a, b)), n_rows, points)
            pool.run_shares(lambda k, a, b, to: to.append((k, b - a)), n_rows, shares)
            assert sorted(rows) == sorted(points) == list(range(n_rows))
            assert [k for k, _ in sorted(shares)] == list(range(pool.n_shares(n_rows)))
            assert sum(size for _, size in shares) == n_rows
        pool.close()


def test_shares_are_done_side_by_side(pool):
    meeting = threading.Barrier(3, timeout=10.0)
    pool.run(lambda *_: meeting.wait(), 3)


@pytest.mark.parametrize('bad', [0, 1, 2])
def test_an_error_in_any_share_is_raised_and_the_pool_goes_on(pool, bad):
    def work(k, *_):
        time.sleep(0.02 * (k != bad))
        done.append(k)
        if k == bad:
            raise ValueError(f'share {k}')

    for _ in range(3):
        done = []
        with pytest.raises(ValueError, match=f'share {bad}'):
            pool.run(work, 3)
        # No thread is still at work on arrays that the caller takes for its own.
        assert sorted(done) == [0, 1, 2]
    pool.run(lambda k, *_: done.append(k), 3)
    assert sorted(done) == [0, 0, 1, 1, 2, 2]


def test_an_interrupted_wait_is_made_up_for(pool):
    begun = threading.Event()

    def slow(k, *_):
        if k == 0:
            begun.wait(10.0)
            raise KeyboardInterrupt
        begun.set()
        time.sleep(0.1)
        late.append(k)

    late = []
    with pytest.raises(KeyboardInterrupt):
        pool.run(slow, 3)
    pool.run(lambda k, *_: late.append(10 + k), 3)
    assert sorted(late) == [1, 2, 10, 11, 12]


@pytest.mark.parametrize('n_threads', [1, 2, 3])
def test_what_was_begun_is_done_once_and_before_anything_else(n_threads):
    pool, done = RowPool(n_threads), []

    def work(*_):
        time.sleep(0.05)
        done.append('begun')

    begun = pool.begin(work)
    begun.finish()
    begun.finish()
    assert done == ['begun']
    begun = pool.begin(work)
    pool.run(lambda *_: done.append('run'), 1)
    # With one thread nobody has begun yet.
    expected = ['begun', *n_threads * ['run']] if n_threads > 1 else ['run', 'begun']
    begun.finish()
    assert done[1:] == expected
    pool.begin(work).drop()
    assert done.count('begun') == (3 if n_threads > 1 else 2)
    with pytest.raises(ZeroDivisionError):
        pool.begin(lambda: 1 / 0).finish()
    pool.close()


def threads_of(n_threads):
    """A pool, and the threads that it has started."""
    before = set(threading.enumerate())
    return RowPool(n_threads), set(threading.enumerate()) - before


def wait_for_end(threads):
    for thread in threads:
        thread.join(timeout=10.0)
        assert not thread.is_alive()


def test_threads_end_when_closed_and_when_forgotten():
    closed, its_threads = threads_of(4)
    forgotten, other_threads = threads_of(2)
    assert (len(its_threads), len(other_threads)) == (3, 1)
    closed.close()
    closed.close()
    wait_for_end(its_threads)
    assert all(thread.is_alive() for thread in other_threads)
    del forgotten
    gc.collect()
    wait_for_end(other_threads)


def test_unasked_there_are_few():
    pool = RowPool(0)
    assert 1 <= pool.n_threads <= MOST_UNASKED
    pool.close()
