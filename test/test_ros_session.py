"""Signals to the commands that talk to a node."""

import os
import signal

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

from ros_helpers import ISOLATION

from gp_ground_seg.ros.lifecycle import ros_session

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    for name, value in ISOLATION.items():
        monkeypatch.setenv(name, value)


def interrupted_by(number, said):
    with ros_session('one'):
        said.append('before')
        os.kill(os.getpid(), number)
        # Python handles it before this at the latest.
        said.append('after')


def held_back(number, said):
    with ros_session('one') as session:
        with session.holding_back():
            os.kill(os.getpid(), number)
            said.append('held back')
        session.check()
        said.append('after')


def misunderstood(number, _said):
    with ros_session('one') as session:
        with session.holding_back():
            os.kill(os.getpid(), number)
        raise RuntimeError('unable to convert')


def failing(_number, _said):
    with ros_session('one'):
        raise RuntimeError('own')


@pytest.mark.parametrize('number', SIGNALS)
@pytest.mark.parametrize(
    ('act', 'expected'),
    [(interrupted_by, ['before']), (held_back, ['held back']), (misunderstood, [])],
)
@pytest.mark.usefixtures('heeded_hangup')
def test_a_signal_interrupts_at_once_or_where_it_may(act, expected, number):
    said = []
    with pytest.raises(KeyboardInterrupt):
        act(number, said)
    assert said == expected


def test_what_the_bindings_make_of_an_interrupt_is_its_cause():
    with pytest.raises(KeyboardInterrupt) as raised:
        misunderstood(signal.SIGTERM, [])
    assert isinstance(raised.value.__cause__, RuntimeError)


def test_without_a_signal_an_error_is_an_error():
    with pytest.raises(RuntimeError, match='own'):
        failing(None, [])
