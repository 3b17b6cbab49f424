import dataclasses

import numpy as np
import pytest
from conftest import hilly_scan
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config, ConfigError, GroundSegmenter, Label, PointCloudError

SEGMENTER = GroundSegmenter(Config())


def same(a, b):
    np.testing.assert_array_equal(a.label, b.label)
    np.testing.assert_array_equal(a.ground_z, b.ground_z)
    np.testing.assert_array_equal(a.ground_std, b.ground_std)


def test_ground_and_boxes_are_told_apart(scan):
    result = SEGMENTER.segment(scan)
    ground = scan[:, 2] < -1.73 + 0.02 * scan[:, 0] + 0.1 * np.sin(0.3 * scan[:, 0]) + 0.2
    assert result.label.dtype == np.uint8
    assert (result.label[ground] == Label.GROUND).mean() > 0.97
    assert (result.label[~ground] == Label.OBSTACLE).mean() > 0.97
    near = np.hypot(scan[:, 0], scan[:, 1]) < 20
    truth = -1.73 + 0.02 * scan[:, 0] + 0.1 * np.sin(0.3 * scan[:, 0])
    assert np.nanmedian(np.abs(result.ground_z - truth)[near]) < 0.05
    assert np.nanmedian(result.ground_std[near]) < 0.1


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
        np.full((3, 3), 1e200),
        np.tile([[4.0, 1.0, -1.7]], (100, 1)),
    ],
)
def test_odd_clouds_work(points):
    result = SEGMENTER.segment(points)
    for values in (result.label, result.ground_z, result.ground_std):
        assert values.shape == (len(points),)
    unknown = ~np.isfinite(points[:, :3]).all(axis=1)
    np.testing.assert_array_equal(result.label == Label.UNKNOWN, unknown)


def test_one_low_point_is_ground_and_a_high_one_is_not():
    assert SEGMENTER.segment(np.array([[10.0, 0.0, -1.7]])).label[0] == Label.GROUND
    high = SEGMENTER.segment(np.array([[10.0, 0.0, 1.0]]))
    assert high.label[0] == Label.OBSTACLE
    assert np.isnan(high.ground_z[0])


@pytest.mark.parametrize(
    ('points', 'words'),
    [
        (np.zeros(3), r'\(3,\)'),
        (np.zeros((5, 2)), r'\(5, 2\)'),
        (np.zeros((2, 5, 3)), r'\(2, 5, 3\)'),
        (np.zeros((5, 3), dtype=np.int32), r'\(5, 3\).*int32'),
        (np.array([['a', 'b', 'c']]), r'\(1, 3\)'),
        (np.zeros((5, 3), dtype=complex), 'complex128'),
    ],
)
def test_wrong_shapes_and_types_are_refused_with_the_shape(points, words):
    with pytest.raises(PointCloudError, match=words):
        SEGMENTER.segment(points)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_permuting_points_permutes_the_result(seed):
    points = hilly_scan(600, seed=seed)
    points[::50] = np.nan
    order = np.random.default_rng(seed).permutation(len(points))
    straight, shuffled = SEGMENTER.segment(points), SEGMENTER.segment(points[order])
    np.testing.assert_array_equal(shuffled.label, straight.label[order])
    np.testing.assert_array_equal(shuffled.ground_z, straight.ground_z[order])


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(-1.0, 5.0))
def test_raising_sensor_and_points_together_shifts_heights_only(seed, lift):
    points = hilly_scan(600, seed=seed)
    raised = points - [0.0, 0.0, lift]
    low, high = (
        GroundSegmenter(Config().replace(**{'sensor.height': height}))
        for height in (1.73, 1.73 + lift)
    )
    a, b = low.segment(points), high.segment(raised)
    # Heights that sit on a threshold may fall to either side by rounding.
    assert (a.label != b.label).sum() <= 1
    np.testing.assert_allclose(b.ground_z, a.ground_z - lift, atol=1e-6)


def test_turning_by_a_segment_turns_the_surface(scan):
    angle = 2 * np.pi / Config().grid.n_segments
    c, s = np.cos(angle), np.sin(angle)
    turned = scan @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    # Which segments teach is fixed; all of them do not change when the scan is turned.
    settings = {'sensor.height': 1.73, 'learning.segment_step': 1}
    given = GroundSegmenter(Config().replace(**settings))
    a, b = given.segment(scan), given.segment(turned)
    np.testing.assert_allclose(b.surface.mean, np.roll(a.surface.mean, 1, axis=0), atol=1e-6)


def test_input_is_never_written_to_nor_kept(scan):
    points = scan.astype(np.float32)
    points.flags.writeable = False
    result = SEGMENTER.segment(points)
    assert not any(
        np.shares_memory(points, value)
        for value in [*vars(result).values(), *vars(result.labelled).values()]
        if isinstance(value, np.ndarray)
    )


def test_layouts_of_the_same_points_give_the_same(scan):
    points = scan.astype(np.float32)
    wide = np.full((len(points), 7), np.nan, dtype=np.float32)
    wide[:, :3] = points
    base = SEGMENTER.segment(points)
    same(base, SEGMENTER.segment(wide))
    same(base, SEGMENTER.segment(np.asfortranarray(points)))
    same(base, SEGMENTER.segment(points.astype('>f4')))
    # Ranges are computed in the precision of the points.
    double = SEGMENTER.segment(points.astype(np.float64))
    np.testing.assert_array_equal(base.label, double.label)
    np.testing.assert_allclose(base.ground_z, double.ground_z, rtol=0, atol=5e-6)
    same(double, SEGMENTER.segment(points.tolist()))


@pytest.mark.parametrize('n_threads', [1, 2, 5])
def test_threads_and_history_do_not_change_a_bit(scan, n_threads):
    other = GroundSegmenter(Config().replace(**{'runtime.n_threads': n_threads}))
    other.segment(hilly_scan(seed=9))
    same(SEGMENTER.segment(scan), other.segment(scan))
    other.close()


def test_backends_agree(scan):
    slow = GroundSegmenter(Config().replace(**{'runtime.backend': 'numpy'}))
    a, b = SEGMENTER.segment(scan), slow.segment(scan)
    assert b.fit.backend == 'numpy'
    np.testing.assert_array_equal(a.label, b.label)
    np.testing.assert_allclose(a.ground_z, b.ground_z, atol=1e-6)
    np.testing.assert_allclose(a.ground_std, b.ground_std, atol=1e-6)


def test_a_wider_tolerance_takes_more_ground(scan):
    counts = []
    for tolerance in (0.01, 0.03, 0.3):
        config = Config().replace(
            **{'label.ground_tolerance': tolerance, 'label.roughness_gain': 0.0}
        )
        counts.append((GroundSegmenter(config).segment(scan).label == Label.GROUND).sum())
    assert counts[0] < counts[1] < counts[2]


def test_configure_takes_effect_on_the_next_scan(scan):
    segmenter = GroundSegmenter()
    before = segmenter.segment(scan)
    segmenter.configure(Config().replace(**{'grid.n_segments': 90, 'runtime.n_threads': 1}))
    after = segmenter.segment(scan)
    assert len(after.surface.mean) == 90
    assert after.fit.n_threads == 1
    segmenter.configure(Config())
    same(before, segmenter.segment(scan))


def test_neighbours_must_fit_round_the_sensor():
    with pytest.raises(ConfigError, match=r'surface\.n_neighbours = 2'):
        Config().replace(**{'grid.n_segments': 4})


def test_times_come_from_the_clock_given(scan):
    ticks = iter(range(100))
    result = GroundSegmenter(Config(), clock=lambda: float(next(ticks))).segment(scan)
    stages = {name: value for name, value in result.timings.items() if name != 'total'}
    assert set(stages.values()) == {1.0}
    assert result.timings['total'] == sum(stages.values())


def test_fit_report_counts(scan):
    fit = SEGMENTER.segment(scan).fit
    values = dataclasses.asdict(fit)
    assert values['mode'] == 'every_frame'
    assert 1 <= fit.n_evaluations <= Config().learning.max_evaluations
    assert fit.theta['sigma_n'] > 0
    assert fit.status in ('converged', 'budget')
    assert 0 < fit.n_inliers <= fit.n_candidates <= len(scan)
    assert 0 < fit.n_segments <= 180
    assert fit.n_lines > 0


def test_a_result_is_not_changed_by_the_next_scan(scan):
    segmenter = GroundSegmenter()
    result = segmenter.segment(scan)
    kept = {
        name: getattr(result, name).copy()
        for name in ('label', 'height', 'margin', 'ground_z', 'ground_std', 'p_ground')
    }
    cell, r = result.grid.cell.copy(), result.grid.r.copy()
    segmenter.segment(hilly_scan(len(scan) + 100, seed=8))
    again = segmenter.segment(scan[::2])
    assert len(again.label) == len(scan[::2])
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(result, name), value)
    np.testing.assert_array_equal(result.grid.cell, cell)
    np.testing.assert_array_equal(result.grid.r, r)
