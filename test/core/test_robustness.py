"""Inputs and uses that once gave a wrong result, a crash or a hang."""

import argparse
import signal
import sys
import tracemalloc

import numpy as np
import pytest
from conftest import fewer, hilly_scan, run_python

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.cli import main as cli
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.compiled.backend import NumbaBackend
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.pipeline.polar_grid import bin_edges

pytestmark = pytest.mark.usefixtures('compiled_code')


def test_many_points_in_one_spot_are_counted(backend):
    # Sums of squares of a quarter of a million returns, 0.4 m from the surface, fit.
    spot = np.tile([10.0, 0.0, -1.52], (260_000, 1))
    spot[::2, 2] += 0.4
    config = Config().replace(**{'faces.max_normal_z': 0.0})
    result = GroundSegmenter(config, backend=backend).segment(np.vstack([hilly_scan(), spot]))
    assert set(result.label[-2:]) == {Label.GROUND, Label.OBSTACLE}


FEW_TILES = """
import numpy as np
from gp_ground_seg import Config, GroundSegmenter
values = {'grid.r_min': 0.2, 'grid.r_max': 1.5, 'grid.n_bins': 5, 'grid.n_segments': 8}
points = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3)) * [1.0, 1.0, 0.0] - [0.0, 0.0, 1.0]
for cell_size in (10.0, 2.0, 1.0):
    values |= {'faces.cell_size': cell_size, 'runtime.backend': 'numba'}
    GroundSegmenter(Config().replace(**values)).segment(points)
"""


def test_few_tiles_are_no_access_beyond_the_tables():
    # Plain Python checks the indices that compiled code does not.
    run_python(FEW_TILES, NUMBA_DISABLE_JIT='1')


@pytest.mark.parametrize(
    'values',
    [
        {'grid.r_max': 400, 'faces.cell_size': 0.125},
        pytest.param(
            {'grid.n_segments': 2048, 'grid.n_bins': 1024, 'grid.bin_growth': 1},
            marks=pytest.mark.slow,
        ),
    ],
)
@pytest.mark.parametrize('make', [NumpyBackend, NumbaBackend])
def test_memory_is_that_of_tiles_and_cells(values, make):
    """With the largest r_max, the smallest tiles and the most cells it is 1.3 GB."""
    config = Config().replace(**values)
    points = np.tile(hilly_scan(4096), (fewer(2, 1), 1))
    tracemalloc.start()
    try:
        segmenter = GroundSegmenter(config, backend=make())
        for _ in range(2):
            segmenter.segment(points)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    n_tiles = (2.0 * config.grid.r_max / config.faces.cell_size) ** 2
    n_bytes = 9 * n_tiles + 184 * config.grid.n_segments * (len(bin_edges(config.grid)) - 1)
    assert 0.4 * n_bytes < peak < 1.05 * n_bytes


def test_an_interrupt_is_130_whatever_compiled_code_makes_of_it(monkeypatch, capsys):
    def garble_interrupt(_arguments):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise SystemError('returned a result with an exception set') from None

    arguments, before = argparse.Namespace(run=garble_interrupt), signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(cli, '_parse', lambda _words: arguments)
    assert cli.main([]) == 130
    assert capsys.readouterr().err == 'gp-ground-seg: interrupted\n'
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize('backend', ['numba', 'numpy'])
def test_a_latent_process_that_swings_far_overflows_nowhere(backend):
    """A prior of 100 log m and hardly any noise: the mean reached 556 between pseudo-inputs."""
    rng = np.random.default_rng(0)
    azimuth, r = rng.uniform(-np.pi, np.pi, 9000), rng.gamma(2.0, 5.0, 9000)
    z = rng.normal(-1.73, 0.5, 9000)
    points = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), z])
    changes = {
        'latent.sigma_f_bar': 100.0, 'latent.sigma_n_bar': 0.01, 'latent.sigma_l_bar': 3.0,
        'latent.candidates_per_pseudo_input': 1.0, 'learning.fixed': 'latent',
        'sensor.height': 1.73, 'runtime.backend': backend,
    }  # fmt: skip
    segmenter = GroundSegmenter(Config().replace(**changes))
    result = segmenter.segment(points)  # warnings are errors
    assert np.nanmax(np.abs(result.log_length_scale)) == MAX_ABS_LOG_LENGTH_SCALE
    ground = result.label == Label.GROUND
    assert ground.any() and np.isfinite(result.height[ground]).all()


@pytest.mark.skipif(sys.platform != 'linux', reason='what glibc does with freed memory')
def test_a_frame_takes_the_memory_of_the_last():
    """Pages that the system maps anew cost more than a pass over them: 1 to 2 us each."""
    script = (
        'import resource; from conftest import hilly_scan\n'
        'from gp_ground_seg import GroundSegmenter\n'
        "segmenter, points = GroundSegmenter(runtime_backend='numpy'), hilly_scan(120_000)\n"
        'def faults(): return resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n'
        'for _ in range(3): segmenter.segment(points).height\n'
        'before = faults()\n'
        'for _ in range(5): segmenter.segment(points).height\n'
        'print((faults() - before) // 5)\n'
    )
    # A scan has 2 MB, or 500 pages; of those that are freed 6,000 came back as new ones.
    assert int(run_python(script)[0]) < 500
