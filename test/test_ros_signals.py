"""SIGINT and SIGTERM: the node ends with code 0, soon, whatever it is doing."""

import os
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

from ros_helpers import (
    ENTRY_POINT,
    MODULE,
    NAMESPACE,
    PATIENCE,
    Link,
    Process,
    isolated_context,
    spinning,
    street,
    to_message,
    wait_for,
)

from gp_ground_seg.jit import HAVE_NUMBA

BOTH = (signal.SIGINT, signal.SIGTERM)
IN_NAMESPACE = ('--ros-args', '-r', f'__ns:={NAMESPACE}', '-p', 'learning.mode:=fixed')
# A scan takes 5 s and more.
SLOW = {
    'numba': (2048, 1024),
    'numpy': (512, 256),
}
SOON = 4.0
"""Half a second of grace, and what a machine that does other things adds to it [s]."""


def heeds_sigterm(process):
    """Whether the process has a handler of its own."""
    with open(f'/proc/{process.popen.pid}/status', encoding='ascii') as status:
        caught = next(line for line in status if line.startswith('SigCgt:'))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


def stat_words(pid):
    with open(f'/proc/{pid}/stat', encoding='ascii') as stat:
        return stat.read().rsplit(')', 1)[1].split()


def cpu_seconds(pid):
    words = stat_words(pid)
    return (int(words[11]) + int(words[12])) / os.sysconf('SC_CLK_TCK')


def is_running(pid):
    try:
        return stat_words(pid)[0] != 'Z'
    except (FileNotFoundError, ProcessLookupError):
        return False


def children(pid):
    found = [int(name) for name in os.listdir('/proc') if name.isdigit()]
    return [one for one in found if is_running(one) and int(stat_words(one)[1]) == pid]


def wait_for_compiler(node):
    """Return the number of the process that compiles for a node, once it works."""
    node.wait_until_ready()
    wait_for(lambda: len(children(node.popen.pid)) == 1, 'compiler')
    (compiler,) = children(node.popen.pid)
    wait_for(lambda: cpu_seconds(compiler) > 2.0, 'work')
    return compiler


def assert_good_end(node, number, words=()):
    code, duration = node.stop(number)
    assert code == 0, node.log
    assert duration < SOON
    assert 'Traceback' not in node.log
    assert 'ERROR' not in node.log


@pytest.mark.parametrize(
    ('start', 'number'), [(ENTRY_POINT, signal.SIGINT), (MODULE, signal.SIGTERM)]
)
def test_while_importing(tmp_path, start, number):
    with Process(*IN_NAMESPACE, folder=tmp_path, start=start) as node:
        wait_for(lambda: heeds_sigterm(node), 'handler')
        assert_good_end(node, number)
        assert 'listening' not in node.log


def test_while_compiling(tmp_path):
    cache = tmp_path / 'cache'
    cache.mkdir()
    with Process(*IN_NAMESPACE, folder=tmp_path, NUMBA_CACHE_DIR=str(cache)) as node:
        compiler = wait_for_compiler(node)
        assert_good_end(node, signal.SIGTERM)
    wait_for(lambda: not is_running(compiler), 'end of the compiler')


@pytest.mark.parametrize(
    ('backend', 'number'),
    [
        pytest.param(
            'numba',
            signal.SIGTERM,
            marks=pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed'),
        ),
        ('numpy', signal.SIGINT),
    ],
)
def test_within_a_long_segmentation(tmp_path, backend, number):
    message = to_message(street(300_000))
    n_segments, n_bins = SLOW[backend]
    settings = {
        'grid.n_segments': n_segments,
        'grid.n_bins': n_bins,
        'learning.max_evaluations': 1000,
        'learning.segment_step': 1,
        'runtime.backend': backend,
    }
    words = ['--ros-args', '-r', f'__ns:={NAMESPACE}']
    for name, value in settings.items():
        words += ['-p', f'{name}:={value}']
    with Process(*words, folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_settled()
        link = Link(context)
        with spinning(context, link.probe):
            link.wait_until_connected()
            before = cpu_seconds(node.popen.pid)
            link.publisher.publish(message)
            wait_for(lambda: cpu_seconds(node.popen.pid) > before + 1.0, 'work')
            assert_good_end(node, number)
            assert not link.ground.messages


@pytest.mark.parametrize('number', BOTH)
def test_under_load(tmp_path, number):
    message = to_message(street(20_000))
    with Process(*IN_NAMESPACE, folder=tmp_path) as node, isolated_context() as context:
        node.wait_until_ready()
        link = Link(context)
        with spinning(context, link.probe):
            link.wait_until_connected()

            def publish_until_busy():
                link.publisher.publish(message)
                return len(link.ground.messages) >= 3

            wait_for(publish_until_busy, 'cloud')
            for _ in range(10):
                link.publisher.publish(message)
            assert_good_end(node, number)


def test_a_second_signal_does_not_break_the_end(tmp_path):
    with Process(*IN_NAMESPACE, folder=tmp_path) as node:
        node.wait_until_ready()
        node.popen.send_signal(signal.SIGINT)
        node.popen.send_signal(signal.SIGINT)
        assert_good_end(node, signal.SIGTERM)


DEAF = """
import hashlib
from gp_ground_seg.ros.lifecycle import stop_on_signals

with stop_on_signals():
    print('ready', flush=True)
    # A minute in one call that lets other threads run, as compiled code does.
    hashlib.pbkdf2_hmac('sha256', b'', b'', 200_000_000)
"""


def test_a_thread_ends_what_does_not_end_itself():
    process = subprocess.Popen(
        [sys.executable, '-c', DEAF],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        assert process.stdout.readline() == 'ready\n'
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0
        assert process.stderr.read() == ''


def test_without_a_signal_all_is_as_before():
    script = (
        'import signal\n'
        'from gp_ground_seg.ros.lifecycle import stop_on_signals\n'
        'before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)\n'
        'with stop_on_signals() as outer:\n'
        '    with stop_on_signals() as stop:\n'
        '        assert not stop.made\n'
        'assert before == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))\n'
        'assert signal.set_wakeup_fd(-1) == -1\n'
    )
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')
