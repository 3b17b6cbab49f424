"""Compiled code on disk: kept, found again, never stale, never in the way."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import hilly_scan
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('numba', reason='there is no compiled code without numba')

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.compiled import instructions, meeting
from gp_ground_seg.compiled.compile_cache import digest
from gp_ground_seg.jit import compiled_signatures

CONSTANT = 'FACTOR = {factor}\n'
CALLEE = """
from gp_ground_seg.compiled import compiled

@compiled
def shifted(x):
    return x + {shift}
"""
CALLER = """
import sys
from pathlib import Path
from constant import FACTOR
from callee import shifted
from gp_ground_seg.compiled import compiled

@compiled
def scaled(x):
    return FACTOR * shifted(x)
"""
SCRIPT = """
import logging, resource, sys
logging.basicConfig(level=logging.INFO, format='%(name)s %(levelname)s %(message)s')
if 'no-space' in sys.argv:
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
import caller
print(caller.scaled(10.0))
"""
COMPILES = 'gp_ground_seg INFO compiling for this processor'
NOT_KEPT = 'gp_ground_seg WARNING compiled code cannot be kept'


class Program:
    """Two modules of compiled code and a constant, in a folder of their own."""

    def __init__(self, folder):
        self._folder = folder
        self._folder.mkdir()
        self._environment = {
            **{k: v for k, v in os.environ.items() if k != 'NUMBA_CACHE_DIR'},
            'XDG_CACHE_HOME': str(folder / 'user'),
        }
        (folder / 'caller.py').write_text(CALLER)
        self.write(factor=2.0, shift=1.0)

    def write(self, factor, shift):
        (self._folder / 'constant.py').write_text(CONSTANT.format(factor=factor))
        (self._folder / 'callee.py').write_text(CALLEE.format(shift=shift))

    def run(self, *words, **environment):
        """Return the number it prints and what it logs."""
        done = subprocess.run(
            [sys.executable, '-B', '-c', SCRIPT, *words], cwd=self._folder,
            env={**self._environment, **environment}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return float(done.stdout), done.stderr

    @property
    def kept(self):
        return sorted((self._folder / '__pycache__').glob('*.nb[ic]'))

    def block(self, *names):
        """Put files where folders would have to be, which stops root as well."""
        for name in names:
            (self._folder / name).touch()
        return str(self._folder / names[-1] / 'below')


@pytest.fixture
def program(tmp_path):
    return Program(tmp_path / 'program')


def test_compiled_once_then_loaded(program):
    value, log = program.run()
    assert value == 22.0
    assert log.count(COMPILES) == 1
    assert len(program.kept) == 4  # index and code of two functions
    assert program.run() == (22.0, '')


def test_changes_in_other_files_are_seen(program):
    program.run()
    program.write(factor=3.0, shift=1.0)
    value, log = program.run()
    assert (value, COMPILES in log) == (33.0, True)
    program.write(factor=3.0, shift=5.0)
    value, log = program.run()
    assert (value, COMPILES in log) == (45.0, True)
    assert program.run() == (45.0, '')


@pytest.mark.parametrize('ending', ['.nbi', '.nbc'])
def test_damaged_files_are_written_anew(program, ending):
    program.run()
    damaged = [path for path in program.kept if path.suffix == ending]
    for path in damaged:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    value, log = program.run()
    assert value == 22.0
    assert 'cannot be used' in log
    assert NOT_KEPT not in log
    assert program.run() == (22.0, '')


def test_nowhere_to_write_costs_time_and_says_so(program):
    # `user` and `__pycache__` are files: no folder can be made there.
    where = program.block('user', '__pycache__')
    for environment in ({}, {'NUMBA_CACHE_DIR': where}):
        value, log = program.run(**environment)
        assert value == 22.0
        assert log.count(COMPILES) == 1
        assert log.count(NOT_KEPT) == 1
        assert 'set NUMBA_CACHE_DIR' in log


def test_full_disk_costs_time_and_says_so(program):
    value, log = program.run('no-space')
    assert value == 22.0
    assert log.count(NOT_KEPT) == 1
    assert re.search(r'__pycache__ \(File too large\)', log)


def test_what_others_may_not_write_they_may_read(program, tmp_path):
    program.run()  # as when an image is built
    assert program.run(NUMBA_CACHE_DIR=program.block('user')) == (22.0, '')
    # Whoever names a folder to write to wants none but that.
    value, log = program.run(NUMBA_CACHE_DIR=str(tmp_path / 'own'))
    assert (value, COMPILES in log) == (22.0, True)


@pytest.fixture(scope='module', params=['fixed', 'every_frame'])
def warm(request):
    config = Config().replace(**{'learning.mode': request.param, 'runtime.n_threads': 2})
    segmenter = GroundSegmenter(config)
    for dtype in (np.float32, np.float64):
        segmenter.segment(hilly_scan(500).astype(dtype))
    yield segmenter
    segmenter.close()


LAYOUTS = {
    'as read': lambda points: points,
    'Fortran order': np.asfortranarray,
    'every second row': lambda points: np.repeat(points, 2, axis=0)[::2],
    'backwards': lambda points: points[::-1],
    'wider': lambda points: np.hstack([points, points])[:, :4],
    'read-only': lambda points: _read_only(points),
    'other byte order': lambda points: points.astype(points.dtype.newbyteorder()),
}


def _read_only(points):
    points = points.copy()
    points.flags.writeable = False
    return points


@settings(max_examples=40)
@given(
    st.integers(0, 9000),
    st.sampled_from([np.float32, np.float64]),
    st.sampled_from(sorted(LAYOUTS)),
    st.integers(3, 5),
)
def test_no_cloud_is_worth_a_new_compilation(warm, n_points, dtype, layout, width):
    before = compiled_signatures()
    points = np.zeros((n_points, width), dtype=dtype)
    points[:, :3] = hilly_scan(n_points, seed=n_points)
    if n_points > 10:
        points[7, 2] = np.nan
    warm.segment(LAYOUTS[layout](points))
    assert compiled_signatures() == before


FIRST_CLOUDS = """
import numpy as np
from conftest import hilly_scan
from gp_ground_seg import Config, GroundSegmenter, meeting
from gp_ground_seg.compile_cache import digest
from gp_ground_seg.compiled import compiled_signatures
from gp_ground_seg.points import single_precision
from gp_ground_seg.ros.warm_up import warm_up

segmenter = GroundSegmenter(Config())
warm_up(segmenter)
before = compiled_signatures()
points = hilly_scan(9000)
for cloud in (points, np.asfortranarray(points), np.hstack([points, points])[:, :3]):
    for cloud in (cloud.astype(np.float32), single_precision(cloud)):
        segmenter.segment(cloud)
        print({k: v for k, v in compiled_signatures().items() if v != before[k]})
"""


COLD_START = """
import logging, resource
import numba.core.event
from gp_ground_seg import GroundSegmenter
from gp_ground_seg.ros.warm_up import warm_up

class Listener(numba.core.event.Listener):
    def on_start(self, event):
        print('compiled here', event.data['dispatcher'].py_func.__name__)

    def on_end(self, event):
        pass

logging.basicConfig(level=logging.INFO, format='%(name)s %(levelname)s %(message)s')
numba.core.event.register('numba:compile', Listener())
warm_up(GroundSegmenter())
"""


def test_a_first_start_has_others_compile(tmp_path):
    """All of it: the compiler would leave hundreds of megabytes behind in the node."""
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}
    for n_said in (1, 0):
        done = subprocess.run(
            [sys.executable, '-c', COLD_START],
            capture_output=True,
            text=True,
            env=environment,
            check=False,
        )
        assert (done.returncode, done.stdout) == (0, ''), done.stderr
        assert done.stderr.count(COMPILES) == n_said, done.stderr


def test_the_first_frame_of_the_node_compiles_all_there_is():
    """In a process of its own: what other tests compiled does not count."""
    script = [sys.executable, '-c', FIRST_CLOUDS]
    done = subprocess.run(
        script, capture_output=True, text=True, cwd=Path(__file__).parent, check=False
    )
    assert (done.returncode, done.stdout) == (0, 6 * '{}\n'), done.stderr


def test_helpers_of_instructions_made_by_hand_are_part_of_the_key(monkeypatch):
    before = digest(meeting.enlist.py_func)
    monkeypatch.setattr(instructions, '_is_owner', lambda argument: False)
    assert digest(meeting.enlist.py_func) != before


def test_instructions_made_by_hand_are_part_of_the_key(monkeypatch):
    before = digest(meeting.claim.py_func)
    assert digest(meeting.claim.py_func) == before
    monkeypatch.setattr(meeting, 'add_to_row', meeting.look_at_row)
    assert digest(meeting.claim.py_func) != before
