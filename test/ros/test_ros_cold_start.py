"""A node whose compiled code is not there yet: on numpy at first, compiled code in the end."""

import threading

import pytest
import ros_helpers as ros
from cli_runner import run
from ros_helpers import street, to_message

from gp_ground_seg import Config
from gp_ground_seg.core import jit, segmenter
from gp_ground_seg.core.jit import HAVE_NUMBA, code_folder
from gp_ground_seg.ros import loader
from gp_ground_seg.ros.loader import CHANGED, FOLLOWS, STAYS, BackendLoader

pytestmark = pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed')

FIXED = {'learning.mode': 'fixed'}


@pytest.mark.slow
def test_node_segments_while_its_code_is_compiled_and_then_changes_over(monkeypatch, tmp_path):
    message = to_message(street(2000))
    cache = tmp_path / 'cache'
    cache.mkdir(mode=0o700)
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(cache))
    # Never from the current folder: this would end the compiler, or the node.
    (tmp_path / 'numpy.py').write_text('raise SystemExit(3)')
    monkeypatch.chdir(tmp_path)
    with ros.linked_process(tmp_path, FIXED) as (node, link):
        link.segment(message)
        assert FOLLOWS in node.log
        assert CHANGED not in node.log
        while CHANGED not in node.log:
            link.segment(message)
        link.segment(message)
        assert node.log.count(FOLLOWS) == node.log.count(CHANGED) == 1
        assert STAYS not in node.log
        node.end_well()
    # All of it is there for the next start.
    with ros.Process(*ros.IN_NAMESPACE, *ros.given(FIXED), folder=tmp_path) as node:
        node.wait_until_settled()
        assert 'compiling' not in node.log


@pytest.fixture
def held_back(monkeypatch):
    """`warm_up` waits for this event."""
    event, real = threading.Event(), segmenter.warm_up

    monkeypatch.setattr(segmenter, 'warm_up', lambda config: event.wait(60.0) and real(config))
    monkeypatch.setattr(jit, 'is_code_kept', lambda: True)
    return event


def backend_after_a_cloud(b, n_seen):
    b.segment(to_message(street(1000)))
    status = b.wait_for_status('processing', lambda v, _: int(v['Clouds since startup']) >= n_seen)
    return ros.values_of(status)['Backend']


def test_numpy_asked_for_meanwhile_stays_and_the_newest_parameters_hold(held_back):
    with ros.bench(settled=False) as b:
        assert not b.set('grid.n_bins', 90)
        assert backend_after_a_cloud(b, 1) == 'numpy'
        assert not b.node._diagnostics.processing.loader.is_done
        assert not b.set('runtime.backend', 'numpy')
        assert b.node._diagnostics.processing.loader is None
        held_back.set()
        ros.wait_for(lambda: b.node._is_compiled, 'compiled code')
        assert backend_after_a_cloud(b, 2) == 'numpy'
        assert not b.set('runtime.backend', 'auto')
        assert backend_after_a_cloud(b, 3) == 'numba'
        assert b.node._segmenter.config == b.node.config


def test_a_failure_is_a_warning_and_the_node_goes_on(monkeypatch, tmp_path):
    monkeypatch.setattr(jit, 'is_code_kept', lambda: False)
    monkeypatch.setattr(loader, '_COMPILE', "raise OSError('no space left')")
    with ros.stderr_in(tmp_path) as said, ros.bench(settled=False) as b:
        assert 'OSError: no space left' in said(STAYS)
        b.segment(to_message(street(1000)))
        assert b.node._segmenter.backend.name == 'numpy'


def test_loader_that_is_closed_calls_nobody(held_back):
    calls = []
    made = BackendLoader(Config(), lambda: calls.append(1))
    made.start()
    made.close()
    assert made.is_alive()
    held_back.set()
    made.join(60.0)
    assert calls == [] and not made.is_done


def test_warm_up_command_says_where_the_code_is(capsys):
    assert run('warm-up') == 0
    said = capsys.readouterr()
    assert said.out.startswith(f'compiled code is kept in {code_folder()}; it was there after ')
    assert said.err.startswith(
        'gp-ground-seg: note: compiling what is not on disk yet: one to two minutes'
    )
