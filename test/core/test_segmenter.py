"""The segmenter: properties of its results, history, callers in threads, forks, backends."""

import concurrent.futures
import copy
import os
import pickle
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
from conftest import fewer, hilly_scan
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import Reference

from gp_ground_seg import Config, ConfigError, GroundSegmenter, Label, PointCloudError
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.gp.evidence import STEP
from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.core.jit import HAVE_NUMBA, JIT_ENABLED

pytestmark = pytest.mark.usefixtures('compiled_code')

# Without compilation the twins take a microsecond for each cell and point.
SIZE = {} if JIT_ENABLED else {'grid.n_segments': 36, 'grid.n_bins': 60, 'grid.bin_growth': 1.5}
CONFIG = Config().replace(**SIZE)
SEGMENTER = GroundSegmenter(CONFIG)
VALUES = 'label', 'height', 'margin', 'ground_z', 'ground_std', 'return_std', 'p_ground'
N_POINTS = fewer(4000, 800)


@pytest.fixture
def scan():
    return hilly_scan(N_POINTS)


def same(a, b):
    for name in VALUES:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def segmenter_of(backend=None, **changes):
    return GroundSegmenter(CONFIG.replace(**changes), backend=backend)


def test_ground_and_boxes_are_told_apart(backend):
    scan = hilly_scan(4000)
    result = GroundSegmenter(CONFIG, backend=backend).segment(scan)
    truth = -1.73 + 0.02 * scan[:, 0] + 0.1 * np.sin(0.3 * scan[:, 0])
    ground = scan[:, 2] < truth + 0.2
    assert result.label.dtype == np.uint8
    assert (result.label[ground] == Label.GROUND).mean() > 0.97
    assert (result.label[~ground] == Label.OBSTACLE).mean() > 0.97
    near = np.hypot(scan[:, 0], scan[:, 1]) < 20
    assert np.nanmedian(np.abs(result.ground_z - truth)[near]) < 0.05
    assert np.nanmedian(result.ground_std[near]) < 0.1
    is_ground = result.label == Label.GROUND
    assert (result.p_ground[is_ground] >= 0.5).all() and (result.p_ground[~is_ground] < 0.5).all()


@pytest.mark.parametrize(
    'points',
    [
        np.empty((0, 3)),
        np.empty((0, 4), dtype=np.float32),
        np.array([[10.0, 0.0, -1.7]]),
        np.array([[50.0, 0.0, 5.0]]),
        np.full((7, 3), np.nan),
        np.full((7, 3), np.inf),
        np.zeros((5, 3)),
        np.concatenate([np.full((3, 3), 1e200), np.tile([[4.0, 1.0, -1.7]], (100, 1))]),
        np.tile([[4.0, 1.0, -1.7]], (100, 1)),
    ],
)
def test_odd_clouds_work(backend, points):
    result = GroundSegmenter(CONFIG, backend=backend).segment(points)
    for name in VALUES:
        assert getattr(result, name).shape == (len(points),)
    unknown = ~np.isfinite(points).all(axis=1) | ~points.any(axis=1)
    np.testing.assert_array_equal(result.label == Label.UNKNOWN, unknown)
    np.testing.assert_array_equal(np.isnan(result.p_ground), unknown)
    if len(points) == 1:
        # One low point is ground, and a high one is not.
        is_low = points[0, 2] < 0.0
        assert result.label[0] == (Label.GROUND if is_low else Label.OBSTACLE)
        assert np.isnan(result.ground_z[0]) == (not is_low)


@pytest.mark.parametrize('place', [(0.0, 0.0, 0.0), (0.9, -0.3, 1.73)])
@pytest.mark.parametrize('angles', [{}, {'sensor.roll': 0.1, 'sensor.pitch': -0.2}])
def test_rays_without_a_return_matter_as_nan_does(backend, place, angles):
    """Whether the origin is a parameter, an argument, or known by the many points there."""
    empty = np.arange(16_000) % 4 != 3
    points = np.empty((16_000, 3), np.float32)
    points[~empty], points[empty] = hilly_scan(4000), place
    with_nan = np.where(empty[:, None], np.nan, points)
    names = 'sensor.origin_x', 'sensor.origin_y', 'sensor.origin_z'
    given = segmenter_of(backend, **angles, **dict(zip(names, place, strict=True)))
    found, expected = given.segment(points), given.segment(with_nan)
    assert (found.label[empty] == Label.UNKNOWN).all() and (found.label[~empty] > 0).all()
    same(found, expected)
    plain = segmenter_of(backend, **angles)
    same(plain.segment(points, origin=place), plain.segment(with_nan, origin=place))
    same(plain.segment(points), plain.segment(with_nan))
    nothing = given.segment(points[empty])
    assert (nothing.label == Label.UNKNOWN).all() and not nothing.warnings


def test_wrong_shapes_and_types_are_refused_with_the_shape():
    for points in (
        np.zeros(3),
        np.zeros((5, 2)),
        np.zeros((2, 5, 3)),
        np.array([['a', 'b', 'c']]),
    ):
        with pytest.raises(PointCloudError, match=re.escape(str(points.shape))):
            SEGMENTER.segment(points)
    for dtype in ('int32', 'complex128'):
        with pytest.raises(PointCloudError, match=rf'\(5, 3\).*{dtype}'):
            SEGMENTER.segment(np.zeros((5, 3), dtype))
    assert len(SEGMENTER.segment(hilly_scan(100)).label) == 100


@settings(max_examples=fewer(8, 3))
@given(st.integers(0, 2**32 - 1))
def test_permuting_points_permutes_the_result(backend, seed):
    points = hilly_scan(600, seed=seed)
    points[::50] = np.nan
    order = np.random.default_rng(seed).permutation(len(points))
    segmenter = GroundSegmenter(CONFIG, backend=backend)
    straight, shuffled = segmenter.segment(points), segmenter.segment(points[order])
    np.testing.assert_array_equal(shuffled.label, straight.label[order])
    np.testing.assert_array_equal(shuffled.ground_z, straight.ground_z[order])


@settings(max_examples=fewer(8, 3))
@given(st.integers(0, 2**32 - 1), st.floats(-1.0, 5.0))
def test_raising_sensor_and_points_together_shifts_heights_only(backend, seed, lift):
    points = hilly_scan(600, seed=seed)
    a = segmenter_of(backend, **{'sensor.height': 1.73}).segment(points)
    raised = {'sensor.height': 1.73 + lift, 'sensor.origin_z': -lift}
    b = segmenter_of(backend, **raised).segment(points - [0, 0, lift])
    # Heights that sit on a threshold may fall to either side by rounding.
    assert (a.label != b.label).sum() <= 1
    np.testing.assert_allclose(b.ground_z, a.ground_z - lift, atol=1e-6)


def test_rotating_by_a_quarter_shifts_the_surface(backend, scan):
    # A quarter turn maps tiles to tiles, and segments that grow first, one of `STEP`, to such.
    n_segments = 16 * STEP if JIT_ENABLED else 8 * STEP
    turned = scan @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]).T
    # The segments that are learned from are fixed; here all are.
    fixed = {'grid.n_segments': n_segments, 'learning.segment_step': 1}
    segmenter = segmenter_of(backend, **{'sensor.height': 1.73, **fixed})
    a, b = segmenter.segment(scan), segmenter.segment(turned)
    shifted = np.roll(a.surface.mean, n_segments // 4, axis=0)
    np.testing.assert_allclose(b.surface.mean, shifted, atol=1e-6)


def test_layouts_of_the_same_points_give_the_same(backend, scan):
    segmenter = GroundSegmenter(CONFIG, backend=backend)
    points = scan.astype(np.float32)
    wide = np.full((len(points), 7), np.nan, dtype=np.float32)
    wide[:, :3] = points
    base = segmenter.segment(points)
    same(base, segmenter.segment(wide))
    same(base, segmenter.segment(np.asfortranarray(points)))
    same(base, segmenter.segment(points.astype('>f4')))
    backwards = segmenter.segment(points[::-1])
    np.testing.assert_array_equal(backwards.label[::-1], base.label)
    # Ranges are computed in the precision of the points.
    double = segmenter.segment(points.astype(np.float64))
    np.testing.assert_array_equal(base.label, double.label)
    np.testing.assert_allclose(base.ground_z, double.ground_z, rtol=0, atol=5e-6)
    same(double, segmenter.segment(points.tolist()))


@pytest.mark.parametrize('tilt', [None, (0.05, -0.04)])
def test_callers_whose_numpy_raises_get_the_same(backend, scan, tilt):
    """``np.seterr(all='raise')`` is the caller's; small numbers become 0 in most frames."""
    scan[::7] = np.nan
    scan[1], scan[2] = (1e300, -1e300, 1e300), (0.0, 1e-300, -1.73)
    segmenter = GroundSegmenter(CONFIG, backend=backend)
    expected = segmenter.segment(scan, tilt)
    model = GroundModel.of(expected)
    places = np.concatenate([scan[:100, :2], [[30.0, 5e-324]]]).T
    heights, knots = model.at(*places), model.knot_points()
    with np.errstate(all='raise'):
        result = segmenter.segment(scan, tilt)
        same(result, expected)
        assert result.fit.n_inliers == expected.fit.n_inliers
        model = GroundModel.of(result)
        np.testing.assert_array_equal(model.at(*places), heights)
        np.testing.assert_array_equal(model.knot_points(), knots)
        np.testing.assert_array_equal(result.pose.level(scan[8:]), expected.pose.level(scan[8:]))


@pytest.mark.parametrize(
    ('name', 'values', 'count'),
    [
        ('origin', values, 3)
        for values in [
            (np.nan, 0, 0), (0, np.inf, 0), (1, 2), (1, 2, 3, 4), 'abc', 5, (0, 0, None),
            (1j, 0, 0), (True, 0, 0), ([1], 0, 0), (10**400, 0, 0), np.eye(3),
        ]
    ]
    + [('tilt', values, 2) for values in [(np.nan, 0), (0,), (0, 0, 0), (0.1, 'auto'), 0.1]],
)  # fmt: skip
def test_tilt_and_origin_are_finite_numbers(name, values, count, scan):
    with pytest.raises(ConfigError, match=rf'\A{name} = .*: must be {count} finite numbers\Z'):
        SEGMENTER.segment(scan, **{name: values})
    taken = np.zeros(count, np.float32)
    same(SEGMENTER.segment(scan, **{name: taken}), SEGMENTER.segment(scan, **{name: [0] * count}))


def test_results_are_equal_to_themselves_and_can_be_copied(scan):
    for result in (SEGMENTER.segment(scan), GroundModel.of(SEGMENTER.segment(scan))):
        twin = pickle.loads(pickle.dumps(copy.deepcopy(result)))
        assert result == result and result != twin
        assert [result, twin].index(twin) == len({result, twin, result}) - 1 == 1


@pytest.mark.parametrize('attempt', [pickle.dumps, copy.deepcopy])
def test_a_segmenter_is_not_pickled_but_its_config_is(attempt, scan):
    with pytest.raises(TypeError, match='cannot pickle'):
        attempt(SEGMENTER)
    other = GroundSegmenter(pickle.loads(pickle.dumps(SEGMENTER.config)))
    same(other.segment(scan), SEGMENTER.segment(scan))


@pytest.mark.parametrize('tilt', [None, (0.05, -0.04)])
def test_the_input_is_not_written_to_and_may_change_afterwards(backend, scan, tilt):
    segmenter = GroundSegmenter(CONFIG, backend=backend)
    for points in (scan.astype(np.float32), np.asfortranarray(scan)):
        expected = segmenter.segment(points.copy(order='K'), tilt)
        for name in VALUES:
            getattr(expected, name)
        points.flags.writeable = False
        result = segmenter.segment(points, tilt)
        arrays = [*vars(result).values(), *result.labelled, *result.grid]
        arrays = [value for value in arrays if isinstance(value, np.ndarray)]
        assert len(arrays) > 6
        assert not any(np.shares_memory(points, value) for value in arrays)
        points.flags.writeable = True
        points[:] = 7.0
        # Values that are computed when they are first asked for are the same too.
        same(result, expected)


@cache
def labelled_by_the_loops(*changes):
    """Scan of few points with these parameters, for each backend in turn."""
    return segmenter_of(Reference(), **dict(changes)).segment(hilly_scan(400))


@pytest.mark.parametrize(
    ('model', 'objective'),
    [
        ('latent', 'map'),
        ('line_gradient', 'paper'),
        ('constant', 'paper'),
        pytest.param('latent', 'paper', marks=pytest.mark.slow),
    ],
)
def test_frames_are_labelled_as_by_the_loops(backend, model, objective):
    changes = {
        'length_scale.model': model,
        'learning.objective': objective,
        'learning.length_scale': 'classes' if objective == 'paper' else 'factor',
        'learning.fixed': 'none' if objective == 'paper' else 'length_scales',
        'learning.max_evaluations': 3,
        'grid.n_segments': 12,
        'grid.n_bins': 60,
    }
    found = segmenter_of(backend, **changes).segment(hilly_scan(400))
    expected = labelled_by_the_loops(*changes.items())
    np.testing.assert_array_equal(found.label, expected.label)
    np.testing.assert_allclose(found.ground_z, expected.ground_z, atol=1e-5)
    np.testing.assert_allclose(found.theta, expected.theta, atol=1e-5)
    assert found.fit.n_evaluations == expected.fit.n_evaluations > 0
    assert found.fit.objective == pytest.approx(expected.fit.objective, rel=1e-6)


def test_stages_are_timed_and_the_fit_report_counts(scan):
    with patch('gp_ground_seg.core.segmenter.perf_counter', map(float, range(100)).__next__):
        result = GroundSegmenter(CONFIG).segment(scan)
    total, fit = result.timings.pop('total'), result.fit
    stages = ['grid', 'pose', 'faces', 'lines', 'learning', 'surface', 'label']
    assert result.timings == dict.fromkeys(stages, 1.0)
    assert total == len(stages)
    assert (fit.mode, fit.backend) == ('every_frame', SEGMENTER.backend.name)
    assert 1 <= fit.n_evaluations <= CONFIG.learning.max_evaluations
    assert fit.theta['sigma_n'] > 0 and np.isfinite(fit.objective)
    assert fit.status in ('converged', 'budget')
    assert 0 < fit.n_inliers <= fit.n_candidates <= len(scan)
    assert 0 < fit.n_segments <= CONFIG.grid.n_segments
    assert 0 < fit.n_lines <= fit.n_pseudo_inputs


def test_a_result_is_not_changed_by_the_next_scan(backend, scan):
    segmenter = GroundSegmenter(CONFIG, backend=backend)
    result = segmenter.segment(scan)
    kept = {name: getattr(result, name).copy() for name in VALUES}
    groups = result.grid, result.candidates, result.lines, result.pseudo, result.surface
    before = [[np.copy(a) for a in group] for group in groups]
    segmenter.segment(hilly_scan(len(scan) + 100, seed=8))
    assert len(segmenter.segment(scan[::2]).label) == len(scan[::2])
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(result, name), value)
    for group, copies in zip(groups, before, strict=True):
        for a, b in zip(group, copies, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize('mode', ['fixed', 'every_frame'])
def test_history_does_not_change_a_bit(backend, scan, mode):
    """Scans of other sizes and precisions, and other tiles, before."""
    config = CONFIG.replace(**{'learning.mode': mode})
    scan[::3] = np.round(scan[::3])  # equal heights
    expected = GroundSegmenter(config, backend=type(backend)()).segment(scan)
    other = GroundSegmenter(config, backend=backend)
    for n_points, dtype in ((2 * N_POINTS, 'f8'), (300, 'f8'), (N_POINTS, 'f4'), (0, 'f8')):
        other.segment(hilly_scan(n_points, seed=9).astype(dtype))
    other.configure(config.replace(**{'faces.cell_size': 0.7}))
    other.segment(hilly_scan(N_POINTS, seed=8))
    other.configure(config)
    result = other.segment(scan)
    same(result, expected)
    np.testing.assert_array_equal(result.theta, expected.theta)


def test_configure_and_use_backend_take_effect_on_the_next_scan(scan):
    segmenter, own = GroundSegmenter(CONFIG), SEGMENTER.backend.name
    segmenter.configure(CONFIG.replace(**{'grid.n_segments': 90}))
    after = segmenter.segment(scan)
    assert len(after.surface.mean) == segmenter.config.grid.n_segments == 90
    expected = SEGMENTER.segment(scan)
    for changes in (
        {'runtime.backend': 'numpy'},
        {'runtime.backend': 'numpy', 'diagnostics.period': 3.0},
        {'runtime.backend': 'numba' if HAVE_NUMBA else 'auto'},
        {'runtime.backend': 'numpy'},
        {},
    ):
        segmenter.configure(CONFIG.replace(**changes))
        result = segmenter.segment(scan)
        name = 'numpy' if changes.get('runtime.backend') == 'numpy' else own
        assert result.fit.backend == segmenter.backend.name == name
        np.testing.assert_array_equal(result.label, expected.label)
    same(result, expected)
    # A backend that was handed over stays until the parameters of the runtime change.
    segmenter.use_backend(given := NumpyBackend())
    segmenter.configure(CONFIG.replace(**{'label.ground_tolerance': 0.2}))
    assert segmenter.backend is given
    segmenter.configure(CONFIG.replace(**{'runtime.backend': 'numpy'}))
    assert segmenter.backend is not given
    segmenter.configure(CONFIG)
    assert segmenter.backend.name == own


def test_callers_take_turns_while_the_segmenter_is_configured():
    scans = [hilly_scan(fewer(n, n // 8), seed=n) for n in (3000, 4000, 5000, 6000)]
    segmenter = GroundSegmenter(CONFIG)
    expected = [segmenter.segment(scan) for scan in scans]
    with ThreadPoolExecutor(4) as callers:
        results = callers.map(segmenter.segment, scans * fewer(10, 1))
        for _ in range(fewer(20, 1)):
            segmenter.configure(CONFIG.replace(**{'diagnostics.period': 2.0}))
            segmenter.segment(scans[0][:100])
    for k, result in enumerate(results):
        same(result, expected[k % len(scans)])


FORK = """
import os, sys, threading, warnings
warnings.simplefilter('ignore')  # newer Pythons warn of a fork beside threads
import numpy as np
from conftest import hilly_scan
from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.compiled.backend import NumbaBackend
scan, is_busy = hilly_scan(int(sys.argv[1])), True
segmenter = GroundSegmenter(Config(), backend=NumbaBackend())
expected = segmenter.segment(scan).label
def work():
    while is_busy:
        assert (segmenter.segment(scan).label == expected).all()
caller = threading.Thread(target=work)
caller.start()
codes = []
for k in range(int(sys.argv[2])):
    child = os.fork()
    if child == 0:
        is_busy = False
        assert (segmenter.segment(scan).label == expected).all()
        segmenter.configure(Config().replace(**{'runtime.backend': 'numba'}))
        assert (segmenter.segment(scan).label == expected).all()
        sys.exit(7)
    codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
is_busy = False
caller.join()
print(codes)
"""


def test_what_a_thread_computes_of_a_result_does_not_hold_up_another_result():
    results = [SEGMENTER.segment(hilly_scan(300)) for _ in range(2)]
    is_asked, may_go_on = threading.Event(), threading.Event()

    def wait(*_):
        is_asked.set()
        assert may_go_on.wait(60.0)
        return 'late'

    compute = 'gp_ground_seg.core.result.FitReport.of'
    with ThreadPoolExecutor(2) as pool:
        with patch(compute, wait):
            late = pool.submit(lambda: results[0].fit)
            assert is_asked.wait(60.0)
        with patch(compute, lambda *_: 'at once'):
            other = pool.submit(lambda: results[1].fit)
            done = concurrent.futures.wait([other], 20.0).done
        may_go_on.set()
        assert done and other.result() == 'at once'
        assert late.result(60.0) == results[0].fit == 'late'


@pytest.mark.slow
def test_a_process_forked_while_another_thread_segments_segments_and_ends():
    n_points, n_children = fewer(4000, 300), fewer(10, 2)
    done = subprocess.run(
        [sys.executable, '-c', FORK, str(n_points), str(n_children)],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
        capture_output=True, text=True, timeout=240.0, check=False,
    )  # fmt: skip
    assert done.stdout == f'{[7] * n_children}\n', done.stderr
