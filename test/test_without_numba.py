"""The package without its optional compiler, and with the compiler off."""

import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import hilly_scan

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.jit import HAVE_NUMBA

needs_numba = pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed')

SCRIPT = """
import sys
import numpy as np
if sys.argv[1] == 'blocked':
    sys.modules['numba'] = None  # import numba raises ImportError
from gp_ground_seg import Config, GroundSegmenter
points = np.load(sys.argv[2])
for _ in range(2):
    result = GroundSegmenter(Config()).segment(points)
np.savez(sys.argv[3], label=result.label, ground_z=result.ground_z)
print(result.fit.backend)
"""


def run(tmp_path, mode, **environment):
    points = hilly_scan(800)
    np.save(tmp_path / 'points.npy', points)
    done = subprocess.run(
        [sys.executable, '-c', SCRIPT, mode, tmp_path / 'points.npy', tmp_path / 'result.npz'],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return points, np.load(tmp_path / 'result.npz'), done


def test_without_numba_labels_are_the_same_and_it_says_so_once(tmp_path):
    points, result, done = run(tmp_path, 'blocked')
    assert done.stdout.strip() == 'numpy'
    assert done.stderr.count('numba is not installed') == 1
    expected = GroundSegmenter().segment(points)
    np.testing.assert_array_equal(result['label'], expected.label)
    np.testing.assert_allclose(result['ground_z'], expected.ground_z, atol=1e-6)


def test_numba_asked_for_by_name_but_missing_is_an_error():
    script = (
        "import sys; sys.modules['numba'] = None\n"
        'from gp_ground_seg import Config, GroundSegmenter, GroundSegError\n'
        "try:\n    GroundSegmenter(Config().replace(**{'runtime.backend': 'numba'}))\n"
        'except GroundSegError as error:\n    print(error)'
    )
    done = subprocess.run(
        [sys.executable, '-c', script], capture_output=True, text=True, check=True
    )
    assert 'pip install numba' in done.stdout


@needs_numba
def test_the_compiled_code_is_right_as_plain_python_too(tmp_path):
    points, result, done = run(tmp_path, 'open', NUMBA_DISABLE_JIT='1')
    assert done.stdout.strip() == 'numba'
    np.testing.assert_array_equal(result['label'], GroundSegmenter().segment(points).label)
