import numpy as np
import pytest

from gp_ground_seg.frame import Candidates, Lines
from gp_ground_seg.parameters.config import LengthScaleConfig
from gp_ground_seg.pipeline.length_scale import (
    candidate_log_length_scale,
    interpolate_along_segments,
    line_gradient_length_scale,
)

CANDIDATES = Candidates(
    r=np.array([2.0, 4.0, 8.0, 5.0]),
    z=np.zeros(4),
    bin=np.arange(4),
    density=np.ones(4),
    offsets=np.array([0, 3, 3, 4]),
    tile=np.zeros(4, dtype=np.int32),
)


def test_formula_flat_limit_and_bounds():
    parameters = LengthScaleConfig(gradient_gain=2.0, flat_gradient=0.05, min=0.5, max=5.0)
    slopes = np.array([0.0, 0.05, -0.2, 0.9, 3.0, np.nan, np.inf])
    flat = 2.0 * np.log(1 / 0.05)
    expected = [min(flat, 5.0), min(flat, 5.0), 2.0 * np.log(5.0), 0.5, 0.5, 0.5, 0.5]
    np.testing.assert_allclose(line_gradient_length_scale(slopes, parameters), expected)


def test_each_candidate_takes_its_lines_length_scale():
    lines = Lines(np.array([0, 0, 1, 2]), np.array([0.0, 0.5, np.nan]), np.array([0, 2, 3, 4]))
    parameters = LengthScaleConfig(model='line_gradient')
    values = np.exp(candidate_log_length_scale(CANDIDATES, lines, parameters))
    by_line = line_gradient_length_scale(lines.slope, parameters)
    np.testing.assert_allclose(values, by_line[[0, 0, 1, 2]])


def test_constant_model():
    lines = Lines(np.zeros(4, dtype=int), np.array([0.3]), np.array([0, 4]))
    values = candidate_log_length_scale(
        CANDIDATES, lines, LengthScaleConfig(model='constant', constant=7.0)
    )
    assert list(values) == [np.log(7.0)] * 4


def test_interpolation_is_numpys_in_each_segment():
    knots = np.linspace(0.0, 100.0, 33)
    value = np.array([1.0, 3.0, -1.0, 6.0])
    table = interpolate_along_segments(CANDIDATES, value, knots)
    np.testing.assert_allclose(table[0], np.interp(knots, CANDIDATES.r[:3], value[:3]))
    assert np.isnan(table[1]).all()
    assert table[2] == pytest.approx(np.full(33, 6.0))
