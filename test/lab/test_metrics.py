"""True labels, counts, ratios, rings, height errors: by hand."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Label
from gp_ground_seg.lab.scoring import metrics
from gp_ground_seg.lab.scoring.metrics import COUNTS, HEIGHT_MEASURES, label_ratios

GROUND_NUMBERS = {40, 44, 48, 49, 60, 72}


def test_ground_classes_are_ground_and_vegetation_is_left_out():
    numbers = [0, 1, 10, 16, 30, 50, 70, 71, 77, 80, 99, 252, 259, 65535, *GROUND_NUMBERS]
    for number, found in zip(numbers, metrics.true_labels(np.array(numbers)), strict=True):
        expected = Label.GROUND if number in GROUND_NUMBERS else Label.OBSTACLE
        assert found == (Label.UNKNOWN if number in (0, 1, 70) else expected), number


def test_ratios_by_hand():
    counts = {'tp': [6, 0, 0], 'fp': [2, 0, 0], 'fn': [4, 0, 0], 'tn': [8, 0, 5]}
    rows = [dict(zip(counts, row, strict=True)) for row in zip(*counts.values(), strict=True)]
    found, nothing, only_obstacles = map(label_ratios, rows)
    assert (found['precision'], found['recall'], found['iou']) == (6 / 8, 6 / 10, 6 / 12)
    assert all(map(math.isnan, [*nothing.values(), *only_obstacles.values()]))
    # Of a frame, row by row the same.
    for name, values in label_ratios(pd.DataFrame(counts)).items():
        expected = [found[name], nothing[name], only_obstacles[name]]
        np.testing.assert_array_equal(values, expected)


def test_counts_of_rings_by_hand():
    """A ring has its nearer edge; what is not finite has none; an unknown label is an obstacle."""
    x = np.array([0.0, 9.9, 10.0, -49.9, 50.0, 3e3, np.nan, np.inf, 5.0], np.float32)
    xy, unknown = np.stack([x, np.zeros_like(x)], axis=-1), Label.UNKNOWN
    label = np.array([1, 2, 1, 2, unknown, 2, 1, 1, 1], np.uint8)
    truth = np.array([1, 1, 2, 2, 1, 2, 1, 1, unknown], np.uint8)
    rings = metrics.count_rings(label, truth, xy)
    assert [ring.pop('range') for ring in rings] == [*metrics.RING_TITLES]
    assert (metrics.RING_TITLES[0], metrics.RING_TITLES[-1]) == ('0-10 m', '> 50 m')
    found = [tuple(ring[name] for name in COUNTS) for ring in rings]
    between = [(0, 0, 0, 0)] * (len(rings) - 4)
    assert found == [(1, 0, 1, 0), (0, 1, 0, 0), *between, (0, 0, 0, 1), (0, 0, 1, 1)]


@pytest.mark.parametrize('n', [0, 2])
def test_height_error_of_nothing(n):
    sums = metrics.height_sums(np.ones(n), np.full(n, np.nan))
    assert (sums['n_points'], sums['n_without_model']) == (0, n)
    found = {name: measure(sums) for name, measure in HEIGHT_MEASURES.items()}
    assert found.pop('without_model') == (1.0 if n else pytest.approx(math.nan, nan_ok=True))
    assert all(map(math.isnan, [*found.values(), sums['median_absolute']]))


@given(st.integers(0, 2**32 - 1), st.integers(2, 30), st.integers(2, 5000))
def test_pooled_height_errors_are_those_of_all_points(seed, n, m):
    rng = np.random.default_rng(seed)
    std, truth = rng.uniform(0.02, 0.2, n + m), rng.normal(size=n + m)
    error = rng.normal(rng.uniform(-0.1, 0.1), std * rng.uniform(0.5, 2.0))
    error[3::10] = np.nan
    parts = slice(None, n), slice(n, None)
    found = [metrics.height_sums(truth[k], (truth + error)[k], std[k]) for k in parts]
    for k, part in zip(parts, found, strict=True):
        expected = np.nanmedian(np.abs(error[k]))
        assert part['median_absolute'] == pytest.approx(expected, rel=1e-9)
    sums = pd.DataFrame(found).sum()
    pooled = {name: measure(sums) for name, measure in HEIGHT_MEASURES.items()}
    known = np.isfinite(error)
    e, s = error[known], std[known]
    assert (sums['n_points'], sums['n_without_model']) == (known.sum(), (~known).sum())
    assert pooled['rmse'] == pytest.approx(np.sqrt(np.mean(e**2)))
    assert pooled['without_model'] == pytest.approx(np.mean(~known))
    assert pooled['bias'] == pytest.approx(e.mean())
    assert pooled['within_1'] == np.mean(np.abs(e) <= s)
    assert pooled['within_2'] == np.mean(np.abs(e) <= 2.0 * s)
