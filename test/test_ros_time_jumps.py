"""Time that jumps back, told from stamps."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('rclpy', reason='ROS is not installed')

from gp_ground_seg.ros.input import JUMP_TOLERANCE as TOLERANCE
from gp_ground_seg.ros.input import StampWatch


@given(st.lists(st.floats(0.0, 5.0)))
def test_a_stamp_far_behind_the_newest_is_a_jump(stamps):
    watch, newest = StampWatch(), None
    for stamp in stamps:
        behind = 0.0 if newest is None else newest - stamp
        jump = watch.note(stamp)
        if behind > TOLERANCE:
            assert jump == behind
            newest = stamp
        else:
            assert jump == 0.0
            newest = stamp if newest is None else max(newest, stamp)


def test_a_bag_played_in_a_loop_jumps_once_a_round():
    watch = StampWatch()
    rounds = [[1317383.0 + 0.1 * k for k in range(20)]] * 3
    assert [sum(watch.note(s) > 0.0 for s in stamps) for stamps in rounds] == [0, 1, 1]


def test_after_a_reset_any_stamp_is_the_first():
    watch = StampWatch()
    watch.note(100.0)
    watch.reset()
    assert watch.note(1.0) == 0.0
