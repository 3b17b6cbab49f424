"""The segmenter: properties of its results, history, callers in threads, forks, backends."""

import copy
import pickle
import re
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import patch

import numpy as np
import pytest
from conftest import fewer, hilly_scan, run_python, simulated

from gp_ground_seg import Config, ConfigError, GroundSegmenter, Label, PointCloudError
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.core.jit import JIT_ENABLED
from gp_ground_seg.core.pipeline.sensor_pose import DEFAULT_HEIGHT

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


THREE = [[10.0, 0.0, -1.0], [0.0, 10.0, -1.0], [-10.0, 0.0, -1.0]]
HUGE = np.where(np.arange(50)[:, None] % 12, np.nan, np.full(3, 1e200))
SPOT = np.tile([[4.0, 1.0, -1.7]], (100, 1))


@pytest.mark.parametrize(
    'points',
    [
        np.empty((0, 3)), np.empty((0, 4), np.float32), np.full((7, 3), np.nan),
        np.full((7, 3), np.inf), np.zeros((5, 3)), np.array([[10.0, 0.0, -1.7]]),
        np.array([[50.0, 0.0, 5.0]]), np.array(THREE), SPOT, HUGE, -1e108 * HUGE,
        np.concatenate([np.full((3, 3), (9.0, 0.0, 1e200)), SPOT]),
    ],
)  # fmt: skip
def test_odd_clouds_work_and_determine_no_pose(backend, points):
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
    pose = result.pose
    assert (pose.height, pose.roll, pose.pitch) == (DEFAULT_HEIGHT, 0.0, 0.0)
    assert not (pose.height_estimated or pose.roll_estimated or pose.pitch_estimated)
    turned = segmenter_of(backend, **{'sensor.roll': 2.0, 'sensor.pitch': 0.3}).segment(points)
    assert len(turned.label) == len(points)


@pytest.mark.parametrize(
    ('place', 'angles'),
    [((0.0, 0.0, 0.0), {}), ((0.9, -0.3, 1.73), {'sensor.roll': 0.1, 'sensor.pitch': -0.2})],
)
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


THREE = (
    (np.nan, 0, 0), (0, np.inf, 0), (1, 2), (1, 2, 3, 4), 'abc', 5, (0, 0, None), (1j, 0, 0),
    (True, 0, 0), ([1], 0, 0), (10**400, 0, 0), np.eye(3),
)  # fmt: skip
TWO = (np.nan, 0), (0,), (0, 0, 0), (0.1, 'auto'), 0.1
FRAMES = 1.0, (np.eye(3),), (np.eye(2), np.zeros(3)), (np.eye(3), [0.0, 0.0, np.nan])
TEN = np.ones((10, 3))
REFUSED = [
    *((np.zeros(shape), {}, re.escape(f'{shape}')) for shape in ((3,), (5, 2))),
    *((np.zeros((2, 5, n)), {}, rf'table after \.reshape\(-1, {n}\)$') for n in (3, 4)),
    *((TEN.astype(dtype), {}, rf'\(10, 3\).*{dtype}') for dtype in ('bool', 'complex128', '<U3')),
    *((TEN.astype(dtype), {}, r'; pass points\.astype\(float\)$') for dtype in ('i4', 'u1', 'i8')),
    (np.zeros((3, 9, 90)), {}, r'it is a table after \.reshape\(3, -1\)\.T$'),
    (np.zeros((1, 9, 3)), {}, r'it is a table after \.reshape\(-1, 3\)$'),
    (np.zeros(12, 'f4'), {}, r'it is a table after \.reshape\(-1, COLUMNS\)$'),
    (np.zeros(5, [(k, 'f4') for k in 'xyz']), {}, r'a table after numpy\.stack\(\[points\[name'),
    (TEN.astype(object), {}, r'; pass points\.astype\(float\)$'),
    (np.ma.masked_greater(TEN, 20.0), {}, r'masked array: pass points\.filled'),
    (np.zeros((8, 65)), {}, r'\(8, 65\): a point is a row; pass points\.T'),
    *((TEN, {'origin': v}, r'\Aorigin = .*: must be 3 finite numbers\Z') for v in THREE),
    *((TEN, {'tilt': v}, r'\Atilt = .*: must be 2 finite numbers\Z') for v in TWO),
    *((TEN, {'box_frame': frame}, '^box_frame = .*: must be a rotation') for frame in FRAMES),
    (TEN, {'fallback': 1.2}, r'fallback = 1\.2: must be a SensorPose'),
]


@pytest.mark.parametrize(('points', 'given', 'message'), REFUSED)
def test_arguments_that_are_refused(points, given, message):
    with pytest.raises(ConfigError if given else PointCloudError, match=message):
        segmenter_of(**{'input.crop_box': (0.0, 1.0) * 3}).segment(points, **given)


@pytest.mark.parametrize('dtype', ['f4', 'f8'])
def test_order_and_layout_of_the_points_do_not_matter(backend, scan, dtype):
    segmenter = GroundSegmenter(CONFIG, backend=backend)
    scan[::50] = np.nan
    points, order = scan.astype(dtype), np.random.default_rng(0).permutation(len(scan))
    base, shuffled = segmenter.segment(points), segmenter.segment(points[order])
    for name in VALUES:
        np.testing.assert_array_equal(getattr(shuffled, name), getattr(base, name)[order])
    wide = np.full((len(points), 7), np.nan, dtype)
    wide[:, :3] = points
    others = [wide, np.asfortranarray(points), points.astype(f'>{dtype}')]
    for other in [*others, *[points.tolist()] * (dtype == 'f8')]:
        same(base, segmenter.segment(other))
    # Ranges are computed in the precision of the points.
    double = segmenter.segment(points.astype(np.float64))
    np.testing.assert_array_equal(base.label, double.label)
    np.testing.assert_allclose(base.ground_z, double.ground_z, rtol=0, atol=5e-6)


def test_callers_whose_numpy_raises_get_the_same(backend, scan):
    """``np.seterr(all='raise')`` is the caller's; small numbers become 0 in most frames."""
    scan[::7] = np.nan
    scan[1], scan[2] = (1e300, -1e300, 1e300), (0.0, 1e-300, -1.73)

    def values():
        result = segmenter_of(backend).segment(scan, (0.05, -0.04))
        model = GroundModel.of(result)
        places = np.concatenate([scan[:100, :2], [[30.0, 5e-324]]]).T
        yield from (getattr(result, name) for name in VALUES)
        yield from (model.at(*places), model.knot_points(), result.pose.level(scan[8:]))
        yield result.fit.n_inliers

    expected = list(values())
    with np.errstate(all='raise'):
        for found, value in zip(values(), expected, strict=True):
            np.testing.assert_array_equal(found, value)


def test_results_can_be_copied_and_of_a_segmenter_its_config(scan):
    for result in (SEGMENTER.segment(scan), GroundModel.of(SEGMENTER.segment(scan))):
        twin = pickle.loads(pickle.dumps(copy.deepcopy(result)))
        assert result == result and result != twin
        assert [result, twin].index(twin) == len({result, twin, result}) - 1 == 1
    with pytest.raises(TypeError, match='cannot pickle'):
        pickle.dumps(SEGMENTER)


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


def test_stages_are_timed_and_the_fit_report_counts(scan):
    with patch('gp_ground_seg.core.segmenter.perf_counter', map(float, range(100)).__next__):
        result = GroundSegmenter(CONFIG).segment(scan)
    stages = ['grid', 'pose', 'faces', 'lines', 'learning', 'surface', 'label']
    assert result.timings == dict.fromkeys(stages, 1.0) | {'total': len(stages)}
    fit = result.fit
    assert (fit.mode, fit.backend) == ('every_frame', SEGMENTER.backend.name)
    assert 1 <= fit.n_evaluations <= CONFIG.learning.max_evaluations
    assert fit.theta['sigma_n'] > 0 and np.isfinite(fit.objective)
    assert fit.status in ('converged', 'budget')
    assert 0 < fit.n_inliers <= fit.n_candidates <= len(scan)
    assert 0 < fit.n_segments <= CONFIG.grid.n_segments and 0 < fit.n_lines <= fit.n_pseudo_inputs


@pytest.mark.parametrize('mode', ['fixed', 'every_frame'])
def test_scans_before_and_after_do_not_change_a_bit(backend, scan, mode):
    """They have other sizes and precisions, and other tiles."""
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
    other.segment(hilly_scan(N_POINTS + 100, seed=8))
    same(result, expected)
    for name in ('grid', 'candidates', 'lines', 'pseudo', 'surface'):
        for a, b in zip(getattr(result, name), getattr(expected, name), strict=True):
            np.testing.assert_array_equal(a, b, err_msg=name)
    np.testing.assert_array_equal(result.theta, expected.theta)


def test_configure_and_use_backend_take_effect_on_the_next_scan(scan):
    segmenter, own = GroundSegmenter(CONFIG), SEGMENTER.backend.name
    segmenter.configure(CONFIG.replace(**{'grid.n_segments': 90}))
    assert len(segmenter.segment(scan).surface.mean) == segmenter.config.grid.n_segments == 90
    for backend, name in (('numpy', 'numpy'), (own, own), ('auto', own)):
        segmenter.configure(CONFIG.replace(**{'runtime.backend': backend}))
        result = segmenter.segment(scan)
        assert result.fit.backend == segmenter.backend.name == name
    same(result, SEGMENTER.segment(scan))
    # A backend that was handed over stays until the parameters of the runtime change.
    segmenter.use_backend(given := NumpyBackend())
    segmenter.configure(CONFIG.replace(**{'label.ground_tolerance': 0.2}))
    assert segmenter.backend is given
    segmenter.configure(CONFIG.replace(**{'runtime.backend': 'numpy'}))
    assert segmenter.backend is not given


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
import os, threading, warnings
warnings.simplefilter('ignore')  # newer Pythons warn of a fork beside threads
from conftest import hilly_scan
from gp_ground_seg import Config, GroundSegmenter
segmenter, scan = GroundSegmenter(Config()), hilly_scan(300)
expected = segmenter.segment(scan).label
is_held, may_end = threading.Event(), threading.Event()
def segment_for_long():
    with segmenter._exclusive():
        is_held.set()
        may_end.wait()
threading.Thread(target=segment_for_long).start()
is_held.wait()
child = os.fork()
if child == 0:
    segmenter.configure(Config().replace(**{'diagnostics.period': 3.0}))
    os._exit(7 * (segmenter.segment(scan).label == expected).all())
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
may_end.set()
"""


def test_a_process_forked_while_another_thread_segments_segments_too():
    assert run_python(FORK) == ('7\n', '')


def test_few_beams_tell_a_low_box_from_a_bump_where_the_road_is_smooth():
    made = simulated('low_boxes', seed=7)
    is_on_box = (made.object_id > 0) & (made.points[:, 2] > -0.7)
    assert (GroundSegmenter().segment(made.points).label[is_on_box] == Label.GROUND).mean() < 0.13
