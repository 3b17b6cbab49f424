"""A node whose compiled code is not there yet: on numpy at first, compiled code in the end."""

import os
import signal
import sys
import threading

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

from cli_runner import run
from conftest import hilly_scan
from ros_helpers import (
    NAMESPACE,
    Bench,
    Link,
    Process,
    isolated_context,
    spinning,
    street,
    to_message,
    wait_for,
)
from test_ros_signals import is_running, wait_for_compiler

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.backend import NumpyBackend
from gp_ground_seg.jit import HAVE_NUMBA, code_folder
from gp_ground_seg.ros import warm_up
from gp_ground_seg.ros.warm_up import CHANGED, FOLLOWS, STAYS, BackendLoader

pytestmark = pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed')
IN_NAMESPACE = ('--ros-args', '-r', f'__ns:={NAMESPACE}', '-p', 'learning.mode:=fixed')
CONFIG = Config()


@pytest.fixture
def cold(tmp_path):
    """Environment of a process whose code is kept in an empty folder of its own."""
    folder = tmp_path / 'cache'
    folder.mkdir(mode=0o700)
    return {'NUMBA_CACHE_DIR': str(folder)}


def test_node_segments_while_its_code_is_compiled_and_then_changes_over(cold, tmp_path):
    message = to_message(street(2000))
    # Never from the current folder: this would end the compiler, or the node.
    (tmp_path / 'numpy.py').write_text('raise SystemExit(3)')
    before = os.getcwd()
    try:
        os.chdir(tmp_path)
        node = Process(*IN_NAMESPACE, folder=tmp_path, start=SAFE_START, **cold)
    finally:
        os.chdir(before)
    with node, isolated_context() as context:
        node.wait_until_ready()
        link = Link(context)
        with spinning(context, link.probe):
            link.wait_until_connected()
            link.publisher.publish(message)
            link.ground.wait(1)
            assert FOLLOWS in node.log
            assert CHANGED not in node.log
            n_clouds = 1
            while CHANGED not in node.log:
                link.publisher.publish(message)
                n_clouds += 1
                link.ground.wait(n_clouds)
            link.publisher.publish(message)
            link.ground.wait(n_clouds + 1)
        assert node.log.count(FOLLOWS) == node.log.count(CHANGED) == 1
        assert STAYS not in node.log
        assert node.stop(signal.SIGINT)[0] == 0
    # All of it is there for the next start.
    with Process(*IN_NAMESPACE, folder=tmp_path, **cold) as node:
        node.wait_until_settled()
        assert 'compiling' not in node.log


# As the installed executable, the folder of which is the first of sys.path.
SAFE_START = (
    '-c', "import sys; sys.path.remove(''); from gp_ground_seg.cli.node import main; "
    'sys.exit(main())',
)  # fmt: skip


def test_compiler_ends_with_a_node_that_is_killed(cold, tmp_path):
    with Process(*IN_NAMESPACE, folder=tmp_path, **cold) as node:
        compiler = wait_for_compiler(node)
        node.popen.kill()
        node.popen.wait()
        wait_for(lambda: not is_running(compiler), 'end of the compiler')


@pytest.fixture
def held_back(monkeypatch):
    """`warm_up` waits for the event; what it made is counted."""
    event, made = threading.Event(), []

    def warm_up_later(config):
        event.wait(60.0)
        made.append(real(config))
        return made[-1]

    real = warm_up.warm_up
    monkeypatch.setattr(warm_up, 'warm_up', warm_up_later)
    monkeypatch.setattr(warm_up, 'is_code_kept', lambda: True)
    return event, made


@pytest.fixture
def node_at_start(held_back):
    with isolated_context() as context:
        b = Bench(context, ('-p', 'learning.mode:=first_frame', '-p', 'diagnostics.period:=0.1'))
        with spinning(context, b.node, b.probe):
            wait_for(lambda: b.publisher.get_subscription_count() == 1, 'subscription')
            wait_for(lambda: b.ground.n_publishers == 1, 'publisher')
            wait_for(lambda: b.obstacles.n_publishers == 1, 'publisher')
            yield b
            held_back[0].set()


def backend_after_a_cloud(b, n_seen):
    b.segment(to_message(street(1000)))
    status = b.wait_for_status('processing', lambda v, _: int(v['Clouds since startup']) >= n_seen)
    values = {entry.key: entry.value for entry in status.values}
    return values['Backend'], int(values['Threads'])


def test_change_over_between_two_frames_keeps_what_was_learned(node_at_start, held_back):
    b = node_at_start
    assert backend_after_a_cloud(b, 1)[0] == 'numpy'
    theta = b.node._segmenter._theta
    held_back[0].set()
    wait_for(lambda: b.node._is_compiled, 'change-over')
    assert backend_after_a_cloud(b, 2)[0] == 'numba'
    assert b.node._segmenter._theta is theta


def test_newest_parameters_win(node_at_start, held_back):
    b = node_at_start
    assert b.set('runtime.n_threads', 1).successful
    assert b.set('label.ground_tolerance', 0.3).successful
    assert backend_after_a_cloud(b, 1)[0] == 'numpy'
    held_back[0].set()
    wait_for(lambda: b.node._is_compiled, 'change-over')
    assert backend_after_a_cloud(b, 2) == ('numba', 1)
    assert b.node._segmenter.config == b.node.config


def test_numpy_asked_for_meanwhile_stays(node_at_start, held_back):
    b = node_at_start
    assert b.set('runtime.backend', 'numpy').successful
    held_back[0].set()
    wait_for(lambda: b.node._is_compiled, 'compiled code')
    assert backend_after_a_cloud(b, 1)[0] == 'numpy'
    assert b.set('runtime.backend', 'auto').successful
    assert backend_after_a_cloud(b, 2)[0] == 'numba'


def test_a_failure_is_a_warning_and_the_node_goes_on(monkeypatch, capfd):
    monkeypatch.setattr(warm_up, 'is_code_kept', lambda: False)
    monkeypatch.setattr(warm_up, '_COMPILE', "raise OSError('no space left')  # {path}")
    with isolated_context() as context:
        b = Bench(context, ())
        log = ''
        with spinning(context, b.node, b.probe):

            def has_warned():
                nonlocal log
                log += capfd.readouterr().err
                return STAYS in log

            wait_for(has_warned, 'warning')
            assert 'OSError: no space left' in log
            wait_for(lambda: b.publisher.get_subscription_count() == 1, 'subscription')
            b.publisher.publish(to_message(street(1000)))
            b.ground.wait(1)
            assert b.node._segmenter.backend_name == 'numpy'


def test_nothing_is_loaded_for_numpy():
    with isolated_context() as context:
        b = Bench(context, ('-p', 'runtime.backend:=numpy'))
        with spinning(context, b.node, b.probe):
            b.wait_until_connected()
            b.segment(to_message(street(1000)))
            assert not b.node._loader.is_started


def test_loader_that_is_closed_calls_nobody_and_frees_its_backend(held_back):
    event, _ = held_back
    calls = []
    loader = BackendLoader(lambda: calls.append(1))
    loader.start(CONFIG)
    loader.stop()
    event.set()
    loader.close()
    assert calls == []
    assert loader.take_backend() is None


def test_relative_cache_folder_and_path_are_not_those_of_the_child(monkeypatch, tmp_path):
    seen = {}

    class Compiler:
        def __init__(self, command, **options):
            seen.update(options, program=command[-1])
            raise OSError('not started')

    monkeypatch.setattr(warm_up.subprocess, 'Popen', Compiler)
    monkeypatch.setattr(warm_up, 'is_code_kept', lambda: False)
    monkeypatch.setattr(warm_up, 'code_folder', lambda: tmp_path)
    monkeypatch.setattr(sys, 'path', ['', 'here', *sys.path])
    monkeypatch.setenv('NUMBA_CACHE_DIR', 'code')
    done = threading.Event()
    loader = BackendLoader(done.set)
    loader.start(CONFIG)
    assert done.wait(60.0)
    loader.close()
    assert seen['cwd'] == '/'
    assert seen['env']['NUMBA_CACHE_DIR'] == os.path.abspath('code')
    assert "'here'" not in seen['program']
    assert 'not started' in loader.error


def test_both_backends_label_alike():
    points = hilly_scan(3000)
    one = GroundSegmenter(CONFIG, backend=NumpyBackend()).segment(points)
    assert (one.label != GroundSegmenter(CONFIG).segment(points).label).sum() <= 2


def test_warm_up_command_says_where_the_code_is(capsys):
    assert run('warm-up') == 0
    said = capsys.readouterr().out
    assert said.startswith(f'compiled code is kept in {code_folder()}; it was there after ')
