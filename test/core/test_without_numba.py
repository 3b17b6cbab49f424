"""The package without its optional compiler, and with the compiler off."""

import os

import numpy as np
import pytest
from conftest import REPOSITORY, hilly_scan, run_python

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.core.jit import HAVE_NUMBA

# Fewer segments than by default: plain Python takes seconds for each frame.
SEGMENTER = GroundSegmenter(grid_n_segments=36)
SCRIPT = """
import sys
import numpy as np
if sys.argv[1] == 'blocked':
    sys.modules['numba'] = None  # import numba raises ImportError
from gp_ground_seg import Config, GroundSegmenter, GroundSegError
points = np.load(sys.argv[2])
for _ in range(2):
    result = GroundSegmenter(grid_n_segments=36).segment(points)
np.savez(sys.argv[3], label=result.label, ground_z=result.ground_z)
print(result.fit.backend)
if sys.argv[1] == 'blocked':
    try:
        GroundSegmenter(Config().replace(**{'runtime.backend': 'numba'}))
    except GroundSegError as error:
        print(error)
"""


@pytest.mark.parametrize('case', ['blocked', 'broken', 'plain'])
def test_without_compiled_code_labels_are_the_same_and_one_line_says_so(tmp_path, case):
    """Without numba, with one that cannot be imported, and with compiling switched off."""
    if case == 'plain' and not HAVE_NUMBA:
        pytest.skip('numba is not installed')
    points, environment = hilly_scan(800, seed=1), {}
    np.save(tmp_path / 'points.npy', points)
    if case == 'broken':  # as beside python3-coverage of Ubuntu 24.04
        (tmp_path / 'numba').mkdir()
        (tmp_path / 'numba/__init__.py').write_text("raise AttributeError('no coverage.types')")
        environment['PYTHONPATH'] = f'{tmp_path}{os.pathsep}{REPOSITORY}'
    environment |= {'NUMBA_DISABLE_JIT': '1'} if case == 'plain' else {}
    words = case, tmp_path / 'points.npy', tmp_path / 'result.npz'
    said, errors = run_python(SCRIPT, *words, **environment)
    result, expected = np.load(tmp_path / 'result.npz'), SEGMENTER.segment(points)
    np.testing.assert_array_equal(result['label'], expected.label)
    np.testing.assert_allclose(result['ground_z'], expected.ground_z, atol=1e-6)
    backend, *by_name = said.splitlines()
    assert backend == ('numba' if case == 'plain' else 'numpy')
    if case == 'blocked':
        assert errors.count('numba is not installed') == 1
        # By name it is an error.
        assert '-m pip install numba; or set runtime.backend to auto' in by_name[0]
    elif case == 'broken':
        line = 'numba cannot be imported: using numpy, several times slower (no coverage.types)'
        assert errors == f'{line}\n'
