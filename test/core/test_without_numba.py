"""The package without its optional compiler, and with the compiler off."""

import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import REPOSITORY, hilly_scan

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.core.jit import HAVE_NUMBA

SCRIPT = """
import sys
import numpy as np
if sys.argv[1] == 'blocked':
    sys.modules['numba'] = None  # import numba raises ImportError
from gp_ground_seg import Config, GroundSegmenter, GroundSegError
points = np.load(sys.argv[2])
for _ in range(2):
    result = GroundSegmenter(Config()).segment(points)
np.savez(sys.argv[3], label=result.label, ground_z=result.ground_z)
print(result.fit.backend)
if sys.argv[1] == 'blocked':
    try:
        GroundSegmenter(Config().replace(**{'runtime.backend': 'numba'}))
    except GroundSegError as error:
        print(error)
"""


def run(tmp_path, mode, **environment):
    points = hilly_scan(800)
    np.save(tmp_path / 'points.npy', points)
    done = subprocess.run(
        [sys.executable, '-c', SCRIPT, mode, tmp_path / 'points.npy', tmp_path / 'result.npz'],
        env={**os.environ, **environment}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result, expected = np.load(tmp_path / 'result.npz'), GroundSegmenter().segment(points)
    np.testing.assert_array_equal(result['label'], expected.label)
    np.testing.assert_allclose(result['ground_z'], expected.ground_z, atol=1e-6)
    return done.stdout.splitlines(), done.stderr


def test_without_numba_labels_are_the_same_and_one_line_says_so(tmp_path):
    lines, errors = run(tmp_path, 'blocked')
    assert lines[0] == 'numpy'
    assert errors.count('numba is not installed') == 1
    # By name it is an error.
    assert '-m pip install numba; or set runtime.backend to auto' in lines[1]


def test_a_numba_that_cannot_be_imported_is_one_line(tmp_path):
    """As beside python3-coverage of Ubuntu 24.04: numba raises AttributeError."""
    (tmp_path / 'numba').mkdir()
    (tmp_path / 'numba' / '__init__.py').write_text("raise AttributeError('no coverage.types')")
    lines, errors = run(tmp_path, 'open', PYTHONPATH=f'{tmp_path}{os.pathsep}{REPOSITORY}')
    assert lines == ['numpy']
    assert errors == (
        'numba cannot be imported: using numpy, several times slower (no coverage.types)\n'
    )


@pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed')
def test_the_compiled_code_is_right_as_plain_python_too(tmp_path):
    assert run(tmp_path, 'open', NUMBA_DISABLE_JIT='1')[0] == ['numba']
