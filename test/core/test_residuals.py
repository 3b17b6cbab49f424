"""The surface corrected by the returns called ground: its height and its standard deviations."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import reference
from conftest import hilly_scan
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import GroundSegmenter, Label
from gp_ground_seg.core.frame import GroundSurface, Labelled, PolarGrid
from gp_ground_seg.core.pipeline import residuals
from gp_ground_seg.core.pipeline.residuals import correct_surface
from gp_ground_seg.lab.simulation import DRIVES, SENSORS, simulate_scan

N_SEGMENTS = 7
KNOTS = np.array([1.0, 2.0, 3.5, 5.0, 7.0, 10.0])


def correct(cells, residuals, surface, noise=0.02, slope_std=0.05, find=correct_surface):
    """Correct a surface of `N_SEGMENTS` by ground returns in some cells."""
    cells, residuals = np.asarray(cells, np.int32), np.asarray(residuals, float)
    label = np.full(len(cells), Label.GROUND, np.uint8)
    grid = PolarGrid(cells, np.ones(len(cells)), KNOTS, N_SEGMENTS)
    labelled = Labelled(label, residuals, residuals)
    return find(surface, labelled, grid, noise, slope_std)


@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_the_correction_is_the_reference(seed, n_returns):
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, N_SEGMENTS * (len(KNOTS) - 1), n_returns)
    residuals = np.round(rng.normal(0.01, 0.05, n_returns) * 2**20) / 2**20
    shape = N_SEGMENTS, len(KNOTS)
    mean, std = rng.normal(-1.7, 0.2, shape), rng.uniform(0.001, 0.1, shape)
    # A segment has no model, and others none from some range on.
    for m, end in enumerate(rng.integers(0, len(KNOTS) + 4, N_SEGMENTS)):
        mean[m, end:] = std[m, end:] = np.nan
    surface = GroundSurface(KNOTS, mean, std, np.ones(0, bool))
    found = correct(cells, residuals, surface)
    values = np.array([found.correction, found.std, found.return_std])
    finds = [partial(reference.correct_surface, takes_first=first) for first in (True, False)]
    one, other = (np.array(correct(cells, residuals, surface, find=find)) for find in finds)
    np.testing.assert_array_equal(np.isnan(one).any(axis=0), np.isnan(mean))
    # The nearest of two knots that are equally far may be either.
    is_one = np.isclose(values, one, rtol=0, atol=1e-7, equal_nan=True).all(axis=0)
    np.testing.assert_allclose(np.where(is_one, one, other), values, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.mean, mean + found.correction, atol=1e-12)
    assert (found.return_std >= found.std)[np.isfinite(mean)].all()


@pytest.mark.parametrize('tilt', [None, (0.05, -0.1)])
def test_height_and_ground_z_are_of_one_surface(tilt):
    points = hilly_scan()
    with_tilt = GroundSegmenter().segment(points, tilt)
    cosine = 1.0 if tilt is None else np.cos(tilt[0]) * np.cos(tilt[1])
    known = np.isfinite(with_tilt.height)
    assert known.sum() > 3000
    over = (points[:, 2] - with_tilt.ground_z) * cosine
    np.testing.assert_allclose(with_tilt.height[known], over[known], atol=1e-9)
    ground = with_tilt.label == Label.GROUND
    for value in (with_tilt.height, with_tilt.ground_std, with_tilt.return_std):
        assert np.isfinite(value[ground]).all()
    # The labels follow from heights over the surface of the process.
    own, corrected = with_tilt.labelled.height[ground], with_tilt.height[ground]
    assert np.sqrt(np.mean(corrected**2)) < 0.95 * np.sqrt(np.mean(own**2))
    assert abs(np.mean(corrected)) < 0.003


@pytest.mark.parametrize(
    'sensor',
    [
        *('hdl-64e', 'vlp-16', 'mid-360'),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ('hdl-32e', 'os1-128')),
    ],
)
def test_the_defaults_fit_every_sensor_and_errors_are_as_large_as_said(sensor):
    """Every scene once, by exact labels and heights; docs/accuracy.md has more seeds."""
    segmenter = GroundSegmenter()
    ratios, errors, ranges = [], [], []
    for name, scene in DRIVES.items():
        mounted = SENSORS[sensor]
        if mounted.n_columns > 900:  # of the mid-360 a scan is of all its rays
            mounted = replace(mounted, n_columns=900)
        made = simulate_scan(scene(0), mounted, np.random.default_rng(0))
        found = segmenter.segment(made.points[:, :3])
        is_ground = found.label == Label.GROUND
        iou = np.sum(is_ground & made.is_ground) / np.sum(is_ground | made.is_ground)
        assert name not in ('flat', 'slope') or iou >= 0.95, name
        own = made.is_ground & np.isfinite(found.ground_z)
        errors.append((found.ground_z - made.ground_z)[own])
        ratios.append(np.abs(errors[-1]) / found.ground_std[own])
        ranges.append(np.hypot(*made.points[own, :2].T))
    ratio = np.concatenate(ratios)
    # With few cells far away, their spread about their own mean was 0.55 to 0.63.
    far = np.concatenate(ranges) > 20.0
    assert 0.64 <= np.mean(ratio[far] <= 1.0) <= 0.74 or sensor == 'mid-360'
    assert 0.60 <= np.mean(ratio <= 1.0) <= 0.80
    assert 0.90 <= np.mean(ratio <= 2.0) <= 0.99
    assert abs(np.median(np.concatenate(errors))) < 0.001


@pytest.mark.parametrize('n_segments', [7, 90, 180])
def test_of_two_knots_as_near_rounding_does_not_choose(n_segments, monkeypatch):
    """The correction came from the other side on another processor, up to 8 cm away."""
    rng = np.random.default_rng(0)
    knots = 2.0 + 118.0 * (np.arange(41) / 40.0) ** 1.5
    seen = rng.random((n_segments, 41)) < 0.2
    distance, nearest = residuals._nearest(knots, seen, ~seen)
    cosine = np.cos
    for ulps in (-2, -1, 1, 2):
        # As of a library of another precision.
        monkeypatch.setattr(np, 'cos', lambda a, n=ulps: cosine(a) * (1.0 + n * 2.0**-52))
        again, other = residuals._nearest(knots, seen, ~seen)
        np.testing.assert_array_equal(other, nearest)
        np.testing.assert_allclose(again, distance, rtol=1e-9)
