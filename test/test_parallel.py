"""Shares of work in threads: all done, errors passed on, threads gone in the end."""

import gc
import sys
import threading
import time
import weakref

import numpy as np
import pytest

from gp_ground_seg.compiled import meeting
from gp_ground_seg.compiled.instructions import pause
from gp_ground_seg.compiled.meeting import (
    GIVEN_UP,
    TO_FOLLOW,
    TO_JOIN,
    all_done,
    claim,
    clear,
    dismiss,
    enlist,
    n_taken,
)
from gp_ground_seg.compiled.parallel import FEWEST_POINTS, MOST_UNASKED, RowPool, Team
from gp_ground_seg.jit import compiled

_MS = np.uint32(1000)
NOBODY, NO_PAUSE = -9, -8


@compiled
def add(share, n_shares, board, late_share, failing_share, n_done, result):
    """Add one to each of `result`, in one stage, after those of `double`."""
    share = enlist(board, share, n_shares)
    if share < 0:
        return
    if share == late_share:
        pause(20 * _MS)
    stage, n_blocks = np.int64(2), len(result)
    block = claim(board, stage, share, n_shares, n_blocks)
    if share == failing_share:
        raise ValueError('that share')
    while block >= 0:
        result[block] += 1
        # So that there is something left for others.
        pause(np.uint32(100))
        block = claim(board, stage, share, n_shares, n_blocks)
    n_done[share] = 1 if all_done(board, stage, share, n_shares, n_blocks) else -1


@compiled
def double(share, n_shares, board, stage, late_share, before, after):
    """Twice the numbers, in two stages of which the second needs all of the first."""
    share = enlist(board, share, n_shares)
    if share < 0:
        return
    if share == late_share:
        pause(20 * _MS)
    n_blocks = len(before)
    block = claim(board, stage, share, n_shares, n_blocks)
    while block >= 0:
        before[block] += block
        if block % 50 == 0 and late_share != NO_PAUSE:
            pause(np.uint32(200))
        block = claim(board, stage, share, n_shares, n_blocks)
    if not all_done(board, stage, share, n_shares, n_blocks):
        return
    stage += 1
    block = claim(board, stage, share, n_shares, n_blocks)
    while block >= 0:
        after[block, 0] += before[block] + before[n_blocks - 1 - block]
        after[block, 1] = share
        block = claim(board, stage, share, n_shares, n_blocks)
    all_done(board, stage, share, n_shares, n_blocks)


@compiled
def hammer(n_calls, n_shares, board, follows, before, after):
    """Call `double` again and again without a pause; calls that did not do everything once.

    If it `follows`, each time twice: the others go on to the second unasked.
    """
    n_wrong, n_blocks = 0, len(before)
    later_before, later_after = np.zeros_like(before), np.zeros_like(after)
    first, second = np.int64(0), np.int64(2)
    for _ in range(n_calls):
        clear(board, n_shares)
        before[:], after[:] = 0.0, 0.0
        later_before[:], later_after[:] = 0.0, 0.0
        if follows:
            later = np.int64(TO_FOLLOW)
            double(later, n_shares, board, second, NO_PAUSE, later_before, later_after)
        double(np.int64(TO_JOIN), n_shares, board, first, NO_PAUSE, before, after)
        if follows:
            double(np.int64(0), n_shares, board, second, NO_PAUSE, later_before, later_after)
        dismiss(board, n_shares)
        wanted = n_blocks - 1
        later_wanted = wanted if follows else 0
        for block in range(n_blocks):
            is_done = before[block] == block and after[block, 0] == wanted
            if not is_done or later_after[block, 0] != later_wanted:
                n_wrong += 1
                break
    return n_wrong


@pytest.fixture
def pool():
    pool = RowPool(3)
    yield pool
    pool.close()


def run_add(pool, n_shares=3, n_blocks=30, late=NOBODY, failing=NOBODY):
    n_done, result = np.zeros(n_shares, dtype=np.int64), np.zeros(n_blocks, dtype=np.int64)
    pool.run(add, n_shares, late, failing, n_done, result)
    return n_done, result


def test_small_clouds_are_not_shared_out(pool):
    assert pool.n_shares(FEWEST_POINTS) == 3
    assert pool.n_shares(FEWEST_POINTS - 1) == 1


@pytest.mark.parametrize('n_threads', [1, 2, 3, 7])
@pytest.mark.parametrize('n_blocks', [0, 1, 5, 200])
def test_each_block_of_each_stage_is_done_once_and_before_the_next_stage(n_threads, n_blocks):
    """Also by more threads than there are cores, and by some that come late."""
    pool = RowPool(n_threads)
    for late in (NOBODY, 0, n_threads - 1):
        before, after = np.zeros(n_blocks), np.zeros((n_blocks, 2))
        pool.run(double, n_threads, 0, late, before, after)
        np.testing.assert_array_equal(before, np.arange(n_blocks))
        np.testing.assert_array_equal(after[:, 0], n_blocks - 1)
    pool.close()


def test_others_take_their_part(pool):
    for n_shares in (3, 1, 3):
        n_done, result = run_add(pool, n_shares, n_blocks=300)
        np.testing.assert_array_equal(result, 1)
        np.testing.assert_array_equal(n_done, 1)


def test_who_did_how_much_is_known(pool):
    team = pool.team(3)
    before, after = np.zeros(200), np.zeros((200, 2))
    team.run(double, 0, NOBODY, before, after)
    for stage in range(2):
        numbers = [n_taken(team.board, stage, share, 3) for share in range(3)]
        assert sum(numbers) == 200
    assert [np.sum(after[:, 1] == share) for share in range(3)] == numbers


def test_nobody_waits_for_threads_that_do_not_wake():
    """As in a forked process, which has none of its parent's threads."""
    team = Team(meeting.make_board(2, 3), 3)
    before, after = np.zeros(20), np.zeros((20, 2))
    for k in range(1, 3):
        team.run(double, 0, NOBODY, before, after)
        np.testing.assert_array_equal(before, k * np.arange(20))
        team = Team(team.board, 3)


@pytest.mark.parametrize('n_threads', [2, 3, 5])
@pytest.mark.parametrize('n_blocks', [1, 3, 60])
@pytest.mark.parametrize('follows', [False, True])
def test_calls_that_follow_at_once_do_not_get_in_each_others_way(n_threads, n_blocks, follows):
    """Workers come while one call ends and the next begins, some of them for the one before."""
    pool, n_wrong = RowPool(n_threads), []
    board = pool.team(n_threads).board
    arguments = board, follows, np.zeros(n_blocks), np.zeros((n_blocks, 2))
    # In a thread of its own: if one waits for ever, it is not this one.
    calls = threading.Thread(
        target=lambda: n_wrong.append(hammer(20_000, n_threads, *arguments)), daemon=True
    )
    calls.start()
    calls.join(timeout=60.0)
    assert n_wrong == [0]
    pool.close()


def test_who_comes_when_all_is_over_finds_nothing_to_do():
    board = meeting.make_board(2, 2)
    before, after = np.zeros(20), np.zeros((20, 2))
    Team(board, 2).run(double, 0, NOBODY, before, after)
    late = threading.Thread(target=meeting.serve, args=(board, 1, 2))
    late.start()
    time.sleep(0.05)
    meeting.send_home(board, 2)
    late.join(timeout=10.0)
    assert not late.is_alive()
    np.testing.assert_array_equal(before, np.arange(20))
    np.testing.assert_array_equal(after[:, 1], 0)


@pytest.mark.parametrize('n_threads', [1, 2, 3])
@pytest.mark.parametrize('late', [NOBODY, 1])
def test_others_go_on_with_what_the_caller_takes_part_in_later(n_threads, late):
    pool = RowPool(n_threads)
    team = pool.team(n_threads)
    before, after = np.zeros(20), np.zeros((20, 2))
    n_done, result = np.zeros(n_threads, dtype=np.int64), np.zeros(30, dtype=np.int64)
    team.begin(double, (0, late, before, after), add, (NOBODY, NOBODY, n_done, result))
    np.testing.assert_array_equal(after[:, 0], 19)
    if n_threads > 1:
        deadline = time.monotonic() + 10.0
        while not result.all() and time.monotonic() < deadline:
            time.sleep(1e-3)
    assert result.all() == (n_threads > 1)
    team.finish()
    np.testing.assert_array_equal(result, 1)
    np.testing.assert_array_equal(n_done, 1)
    team.dismiss()
    team.dismiss()
    pool.close()


def test_what_was_begun_and_is_not_wanted_is_left_before_anything_else(pool):
    n_done, unwanted = np.zeros(3, dtype=np.int64), np.zeros(3000, dtype=np.int64)
    first = 0, NOBODY, np.zeros(5), np.zeros((5, 2))
    pool.team(3).begin(double, first, add, (NOBODY, NOBODY, n_done, unwanted))
    _, result = run_add(pool)
    np.testing.assert_array_equal(result, 1)
    left = unwanted.copy()
    time.sleep(0.02)
    np.testing.assert_array_equal(unwanted, left)


def test_arrays_are_lent_and_given_back(pool):
    class Owned(np.ndarray):
        """Array that a weak reference can be had of."""

    result = np.zeros(30, dtype=np.int64).view(Owned)
    n_done, gone = np.zeros(3, dtype=np.int64), weakref.ref(result)
    n_references = sys.getrefcount(result)
    for _ in range(20):
        team = pool.team(3)
        first = 0, NOBODY, np.zeros(5), np.zeros((5, 2))
        team.begin(double, first, add, (NOBODY, NOBODY, n_done, result))
        team.dismiss()
        team.run(double, 0, NOBODY, np.zeros(5), np.zeros((5, 2)))
    pool.team(3)
    del team
    assert sys.getrefcount(result) == n_references
    del result
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize(
    ('failing', 'error', 'message'),
    [
        (0, ValueError, 'that share'),
        (1, RuntimeError, 'a thread of the segmentation failed'),
        (2, RuntimeError, 'a thread of the segmentation failed'),
    ],
)
def test_an_error_in_any_share_is_raised_and_the_pool_goes_on(pool, failing, error, message):
    for _ in range(3):
        # Only the caller late: the others get as far as to fail.
        with pytest.raises(error, match=message):
            run_add(pool, n_blocks=300, late=NOBODY if failing == 0 else 0, failing=failing)
    n_done, result = run_add(pool, n_blocks=300)
    np.testing.assert_array_equal(result, 1)
    np.testing.assert_array_equal(n_done, 1)


def test_an_error_in_the_second_work_is_raised_and_the_pool_goes_on(pool):
    def do_both(failing):
        n_done, result = np.zeros(3, dtype=np.int64), np.zeros(3000, dtype=np.int64)
        first = 0, NOBODY, np.zeros(5), np.zeros((5, 2))
        team = pool.team(3)
        # Of another thread's it may be known before the caller comes to that work.
        team.begin(double, first, add, (0, failing, n_done, result))
        team.finish()

    for failing, error in ((0, ValueError), (1, RuntimeError)):
        with pytest.raises(error):
            do_both(failing)
    _, result = run_add(pool, n_blocks=300)
    np.testing.assert_array_equal(result, 1)


def test_an_interrupted_call_is_made_up_for(pool):
    @compiled
    def slow(share, n_shares, board, late):
        share = enlist(board, share, n_shares)
        if share > 0:
            pause(50 * _MS)
            late[share] += 1

    def interrupted(share, n_shares, board, late):
        slow(TO_JOIN, n_shares, board, late)
        time.sleep(0.02)
        raise KeyboardInterrupt

    late = np.zeros(3)
    slow(0, 1, pool.team(1).board, late)
    for k in range(1, 3):
        with pytest.raises(KeyboardInterrupt):
            pool.run(interrupted, 3, late)
        # No thread is still at work on arrays that the caller takes for its own.
        np.testing.assert_array_equal(late, [0, k, k])


def test_more_arguments_than_there_is_room_for_are_refused():
    @compiled
    def greedy(share, n_shares, board, arrays):
        share = enlist(board, share, n_shares)

    with pytest.raises(ValueError, match='too many arguments'):
        greedy(0, 1, meeting.make_board(1, 1), 80 * (np.zeros(1),))


def test_threads_begin_with_neighbours_and_help_out_when_those_are_done():
    board = meeting.make_board(1, 2)
    taken = [claim(board, 0, share, 2, 6) for share in (0, 0, 1, 0, 0, 1, 1, 0)]
    assert taken == [0, 1, 3, 2, 4, 5, -1, -1]
    assert board[GIVEN_UP, 0] == 0


def threads_of(n_threads):
    """A pool, and the threads that it has started."""
    before = set(threading.enumerate())
    pool = RowPool(n_threads)
    assert set(threading.enumerate()) == before, 'nothing to do yet'
    pool.team(n_threads)
    return pool, set(threading.enumerate()) - before


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
