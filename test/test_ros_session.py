"""Signals to the commands that talk to a node."""

import os
import signal

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

from gp_ground_seg.ros.session import ros_session


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_interrupts_at_once_or_where_it_may(number):
    with pytest.raises(KeyboardInterrupt), ros_session('one'):
        os.kill(os.getpid(), number)
        signal.sigtimedwait([], 0.0)  # Python handles it here at the latest
        pytest.fail('not interrupted')
    with pytest.raises(KeyboardInterrupt), ros_session('other') as session:
        with session.holding_back():
            os.kill(os.getpid(), number)
            held_back = True
        assert held_back
        session.check()
        pytest.fail('not interrupted')


def test_what_the_bindings_make_of_an_interrupt_is_one():
    with pytest.raises(KeyboardInterrupt) as raised, ros_session('one') as session:
        with session.holding_back():
            os.kill(os.getpid(), signal.SIGTERM)
        raise RuntimeError('unable to convert')
    assert isinstance(raised.value.__cause__, RuntimeError)


def test_without_a_signal_an_error_is_an_error():
    with pytest.raises(RuntimeError, match='own'), ros_session('one'):
        raise RuntimeError('own')
