import math
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from gp_ground_seg.frame import Candidates
from gp_ground_seg.parameters.config import LinesConfig
from gp_ground_seg.pipeline.line_extraction import deming_slope, extract_lines


def one_segment(r, z, density=None):
    r, z = np.asarray(r, dtype=float), np.asarray(z, dtype=float)
    density = np.ones(len(r)) if density is None else np.asarray(density, dtype=float)
    nowhere = np.zeros(len(r), dtype=np.int32)
    return Candidates(r, z, np.arange(len(r)), density, np.array([0, len(r)]), nowhere)


def moments(r, z):
    r, z = r - r.mean(), z - z.mean()
    return float(r @ r), float(z @ z), float(r @ z)


def negative_likelihood(line, r, z, ratio):
    """Sum of squared distances with the true ranges profiled out."""
    slope, intercept = line
    return np.sum((z - intercept - slope * r) ** 2) / (ratio + slope**2)


def test_deming_is_the_maximum_likelihood_line():
    rng = np.random.default_rng(0)
    for true_slope in (-2.0, -0.1, 0.0, 0.5, 8.0):
        r = np.linspace(0.0, 10.0, 40)
        z = true_slope * r + rng.normal(0, 0.1, 40)
        r = r + rng.normal(0, 0.1, 40)
        for ratio in (0.25, 1.0, 9.0):
            ml = minimize(negative_likelihood, [true_slope, 0.0], (r, z, ratio), tol=1e-12)
            assert deming_slope(*moments(r, z), ratio) == pytest.approx(ml.x[0], abs=1e-4)


def test_deming_agrees_with_odrpack():
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', DeprecationWarning)  # SciPy hands it over to odrpack
        odr = pytest.importorskip('scipy.odr', reason='SciPy 1.19 and later have no odr')
    rng = np.random.default_rng(5)
    r = np.linspace(0.0, 10.0, 40) + rng.normal(0, 0.1, 40)
    z = 0.4 * r + rng.normal(0, 0.1, 40)
    for ratio in (0.25, 1.0, 9.0):
        data = odr.RealData(r, z, sx=1.0, sy=math.sqrt(ratio))
        fitted = odr.ODR(data, odr.unilinear, beta0=[0.4, 0.0]).run()
        assert deming_slope(*moments(r, z), ratio) == pytest.approx(fitted.beta[0], abs=1e-5)


def test_deming_with_all_error_in_height_is_least_squares():
    rng = np.random.default_rng(1)
    r = np.linspace(0.0, 5.0, 30)
    z = 0.3 * r + rng.normal(0, 0.2, 30)
    slope = np.polyfit(r, z, 1)[0]
    assert deming_slope(*moments(r, z), 1e9) == pytest.approx(slope, rel=1e-6)


def test_deming_of_a_vertical_line_is_infinite_and_of_a_point_is_level():
    assert deming_slope(0.0, 4.0, 0.0, 1.0) == math.inf
    assert deming_slope(0.0, 0.0, 0.0, 1.0) == 0.0
    assert deming_slope(4.0, 0.0, 0.0, 1.0) == 0.0


def slow_extract(r, z, density, lines):
    """The same rule with every fit made anew by SVD (error ratio 1)."""

    def fit(rs, zs):
        if len(rs) == 1:
            return math.nan, zs.mean()
        centred = np.column_stack([rs - rs.mean(), zs - zs.mean()])
        direction = np.linalg.svd(centred, full_matrices=False)[2][0]
        return direction[1] / direction[0], rs.mean()

    ids, start, current = [], 0, 0
    while start < len(r):
        stop = start + 1
        while stop < len(r):
            if r[stop] - r[stop - 1] > lines.max_gap + lines.max_gap_growth * r[stop]:
                break
            ratio = density[stop] / density[stop - 1]
            if max(ratio, 1 / ratio) > lines.max_density_ratio:
                break
            if stop - start > 1:
                old, _ = fit(r[start:stop], z[start:stop])
                new, _ = fit(r[start : stop + 1], z[start : stop + 1])
                before = z[start:stop].mean() + old * (r[stop] - r[start:stop].mean())
                after = z[start : stop + 1].mean() + new * (r[stop] - r[start : stop + 1].mean())
                if abs(math.atan(new) - math.atan(old)) > lines.slope_tolerance:
                    break
                if abs(after - before) > lines.offset_tolerance:
                    break
                if abs(z[stop] - before) / math.hypot(1, old) > lines.max_line_distance:
                    break
            stop += 1
        ids += [current] * (stop - start)
        start, current = stop, current + 1
    return ids


@given(st.integers(0, 10_000), st.integers(1, 40))
def test_running_sums_give_the_lines_of_fits_made_anew(seed, n):
    rng = np.random.default_rng(seed)
    r = 3.0 + np.cumsum(rng.uniform(0.2, 1.5, n))
    z = np.cumsum(rng.normal(0, 0.08, n))
    density = np.exp(rng.normal(0, 0.8, n))
    lines = LinesConfig()
    extracted = extract_lines(one_segment(r, z, density), lines)
    assert list(extracted.line) == slow_extract(r, z, density, lines)
    firsts = [0, *(np.flatnonzero(np.diff(extracted.line)) + 1), n]
    assert list(extracted.start) == firsts


@given(st.floats(-0.4, 0.4), st.floats(0.45, 0.8), st.booleans())
def test_a_kink_is_a_critical_point(angle, turn, up):
    first_slope, second_slope = math.tan(angle), math.tan(angle + (turn if up else -turn))
    r = np.arange(3.0, 23.0)
    z = np.where(r <= 12.0, first_slope * r, first_slope * 12.0 + second_slope * (r - 12.0))
    lines = extract_lines(one_segment(r, z), LinesConfig(max_gap=5.0))
    assert list(lines.line) == [0] * 10 + [1] * 10
    np.testing.assert_allclose(lines.slope, [first_slope, second_slope], atol=1e-9)


def test_a_gap_ends_a_line_and_may_be_wider_far_away():
    lines = LinesConfig(max_gap=1.0, max_gap_growth=0.1)
    r = [3.0, 4.0, 6.0, 50.0, 55.0]
    assert list(extract_lines(one_segment(r, np.zeros(5)), lines).line) == [0, 0, 1, 2, 2]


def test_a_sharp_change_of_density_ends_a_line():
    lines = LinesConfig(max_density_ratio=8.0)
    density = [10.0, 20.0, 2.4, 2.4, 30.0]
    found = extract_lines(one_segment([3, 4, 5, 6, 7], np.zeros(5), density), lines)
    assert list(found.line) == [0, 0, 1, 1, 2]


def test_extent_of_lines():
    candidates = one_segment([3.0, 4.0, 6.0, 50.0], np.zeros(4))
    lines = extract_lines(candidates, LinesConfig(max_gap=5.0))
    np.testing.assert_array_equal(lines.extent(candidates), [3.0, 0.0])


def test_lines_do_not_cross_segments_and_lone_points_have_no_slope():
    candidates = Candidates(
        np.array([3.0, 4.0, 5.0]),
        np.zeros(3),
        np.arange(3),
        np.ones(3),
        np.array([0, 2, 2, 3]),
        np.zeros(3, dtype=np.int32),
    )
    lines = extract_lines(candidates, LinesConfig())
    assert list(lines.line) == [0, 0, 1]
    assert lines.slope[0] == 0.0
    assert np.isnan(lines.slope[1])


def test_no_candidates():
    lines = extract_lines(one_segment([], []), LinesConfig())
    assert len(lines.line) == len(lines.slope) == 0


def test_what_continues_a_line_long_and_flat_enough():
    # A road, a ramp of 0.3, a wall of three candidates.
    r = np.concatenate([np.arange(2.0, 8.0), np.arange(8.0, 14.0), [14.0, 14.1, 14.2]])
    z = np.concatenate([np.zeros(6), 0.3 * np.arange(1.0, 7.0), [2.5, 3.5, 4.5]])
    lines = extract_lines(one_segment(r, z), LinesConfig())
    assert list(lines.start) == [0, 6, 12, 15]
    ramp_and_road = [*range(1, 6), *range(7, 12)]
    assert list(np.flatnonzero(lines.continued(1.0, 4))) == ramp_and_road
    assert list(np.flatnonzero(lines.continued(0.2, 4))) == list(range(1, 6))
    assert list(np.flatnonzero(lines.continued(20.0, 3))) == [*ramp_and_road, 13, 14]
    assert not lines.continued(1.0, 7).any()
