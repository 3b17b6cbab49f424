"""Shares of work in threads: all done, errors passed on, threads gone in the end."""

import gc
import threading
import time

import pytest

from gp_ground_seg import meeting
from gp_ground_seg.meeting import GIVEN_UP, all_done, claim, n_taken
from gp_ground_seg.parallel import FEWEST_POINTS, MOST_UNASKED, RowPool


@pytest.fixture
def pool():
    pool = RowPool(3)
    yield pool
    pool.close()


def test_small_clouds_are_not_shared_out(pool):
    assert pool.n_shares(FEWEST_POINTS) == 3
    assert pool.n_shares(FEWEST_POINTS - 1) == 1


def test_everyone_has_another_share_and_all_are_done(pool):
    for n_shares in (3, 1, 3):
        done = []
        pool.run(lambda share, n, board, to: to.append((share, n)), n_shares, done)
        assert sorted(done) == [(k, n_shares) for k in range(n_shares)]


def test_shares_are_done_side_by_side(pool):
    meeting = threading.Barrier(3, timeout=10.0)
    pool.run(lambda *_: meeting.wait(), 3)


@pytest.mark.parametrize('bad', [0, 1, 2])
def test_an_error_in_any_share_is_raised_and_the_pool_goes_on(pool, bad):
    def work(share, *_):
        time.sleep(0.02 * (share != bad))
        done.append(share)
        if share == bad:
            raise ValueError(f'share {share}')

    for _ in range(3):
        done = []
        with pytest.raises(ValueError, match=f'share {bad}'):
            pool.run(work, 3)
        # No thread is still at work on arrays that the caller takes for its own.
        assert sorted(done) == [0, 1, 2]
    pool.run(lambda share, *_: done.append(share), 3)
    assert sorted(done) == [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize('bad', [0, 1, 2])
def test_nobody_waits_for_what_a_thread_that_failed_had_claimed(pool, bad):
    def work(share, n_shares, board):
        claim(board, 0, share, n_shares, 3)
        if share == bad:
            raise ValueError(f'share {share}')
        came_to_an_end[share] = all_done(board, 0, share, n_shares, 3)

    came_to_an_end = {}
    with pytest.raises(ValueError, match=f'share {bad}'):
        pool.run(work, 3)
    assert came_to_an_end == {share: False for share in range(3) if share != bad}


def test_an_interrupted_wait_is_made_up_for(pool):
    begun = threading.Event()

    def slow(share, *_):
        if share == 0:
            begun.wait(10.0)
            raise KeyboardInterrupt
        begun.set()
        time.sleep(0.1)
        late.append(share)

    late = []
    with pytest.raises(KeyboardInterrupt):
        pool.run(slow, 3)
    pool.run(lambda share, *_: late.append(10 + share), 3)
    assert sorted(late) == [1, 2, 10, 11, 12]


@pytest.mark.parametrize('n_threads', [1, 2, 3])
def test_others_go_on_with_what_the_caller_takes_part_in_later(n_threads):
    pool, done = RowPool(n_threads), []
    team = pool.team(n_threads)
    team.start(lambda share: done.append(('first', share)), lambda k: done.append(('then', k)))
    team.take_part(lambda share: done.append(('first', share)))
    team.take_part(lambda share: done.append(('then', share)))
    team.wait()
    team.wait()
    assert sorted(done) == [(word, k) for word in ('first', 'then') for k in range(n_threads)]
    pool.close()


def test_what_nobody_waited_for_is_done_before_anything_else(pool):
    done = []

    def slow(_):
        time.sleep(0.05)
        done.append('slow')
        raise ValueError('that nobody asks for')

    pool.team(3).start(slow)
    pool.run(lambda *_: done.append('run'), 3)
    assert done == 2 * ['slow'] + 3 * ['run']


@pytest.mark.parametrize('n_threads', [1, 2, 3, 7])
@pytest.mark.parametrize('n_blocks', [0, 1, 5, 200])
def test_each_block_of_each_stage_is_done_once_and_before_the_next_stage(n_threads, n_blocks):
    """Also by more threads than there are cores, and by some that come late."""

    def work(share, n_shares, board):
        if share == n_shares - 1 > 0:
            time.sleep(0.01)
        for stage in range(3):
            own = []
            while (block := claim(board, stage, share, n_shares, n_blocks)) >= 0:
                done.append((stage, block))
                own.append(block)
                if block % 50 == 0:
                    time.sleep(1e-3)
            assert all_done(board, stage, share, n_shares, n_blocks)
            assert len(done) >= (stage + 1) * n_blocks
            taken[stage, share] = len(own)
        seen = [[n_taken(board, s, k, n_shares) for k in range(n_shares)] for s in range(3)]
        assert [sum(numbers) for numbers in seen] == 3 * [n_blocks]

    pool = RowPool(n_threads)
    for _ in range(3):
        done, taken = [], {}
        pool.run(work, n_threads)
        assert sorted(done) == [(stage, k) for stage in range(3) for k in range(n_blocks)]
        assert sum(taken.values()) == 3 * n_blocks
    pool.close()


def test_threads_begin_with_neighbours_and_help_out_when_those_are_done():
    board = meeting.make_board(1, 2)
    taken = [claim(board, 0, share, 2, 6) for share in (0, 0, 1, 0, 0, 1, 1, 0)]
    assert taken == [0, 1, 3, 2, 4, 5, -1, -1]
    assert board[GIVEN_UP, 0] == 0


def test_nobody_waits_for_ever_for_others_to_settle():
    board = meeting.make_board(0, 3)
    meeting.settle(board)
    meeting.await_settled(board, 0, 1)
    meeting.await_settled(board, 0, 2)
    assert board[meeting.SETTLED, 0] == 1


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
