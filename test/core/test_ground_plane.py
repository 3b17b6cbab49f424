"""The plane of the ground near the sensor: both backends on clutter and on anything."""

from itertools import islice

import numpy as np
import pytest
from conftest import BACKENDS, fewer
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.core.compiled import ground_plane as compiled
from gp_ground_seg.core.frame import Candidates
from gp_ground_seg.core.pipeline import ground_plane
from gp_ground_seg.core.pipeline.ground_plane import MIN_CELLS, solve_plane


def random_candidates(seed, n_segments, n_bins, share):
    """Few cells or many; equally low ones; nearer, farther and lower than what counts."""
    rng = np.random.default_rng(seed)
    n = rng.binomial(n_bins, share, n_segments)
    offsets = np.concatenate([[0], np.cumsum(n)])
    r = [np.sort(rng.choice(np.geomspace(0.4, 50.0, 60), k, replace=False)) for k in n]
    z = np.round(rng.choice([-1.7, 0.0, 70.0], offsets[-1], p=[0.8, 0.15, 0.05]), 1)
    z += np.round(rng.normal(0.0, 0.1, offsets[-1]), 1)
    own_bin = np.zeros(offsets[-1], dtype=np.int64)
    density, tile = np.zeros(offsets[-1]), np.zeros(offsets[-1], dtype=np.int32)
    azimuth = np.repeat(np.arange(n_segments) * 2 * np.pi / n_segments, n)
    x_y = np.concatenate(r) * (np.cos(azimuth), np.sin(azimuth))
    return Candidates(np.concatenate(r), z, own_bin, density, offsets, tile, *x_y)


@settings(max_examples=fewer(20, 10))
@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.integers(0, 40), st.floats(0.0, 1.0))
def test_backends_agree_on_anything(seed, n_segments, n_bins, share):
    candidates = random_candidates(seed, n_segments, n_bins, share)
    found = (list(islice(backend.find_planes(candidates, 0.577), 3)) for backend in BACKENDS)
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
        assert 0.0 < a.support <= 1.0 and a.n_support <= ground_plane.N_CELLS


def test_floor_at_the_foot_of_a_wall_lies_on_the_plane_of_the_floor():
    """Of its cells, one point is floor, and nine are wall."""
    m, r = np.repeat(np.arange(180), 8), np.tile(np.arange(2.0, 6.0, 0.5), 180)
    z = np.where((r < 5.0) | ((r == 5.0) & (m % 5 == 0)), -1.0, -0.5)
    zero, offsets = np.zeros(len(r), np.int32), np.arange(181) * 8
    x_y = r * (np.cos(m * np.pi / 90.0), np.sin(m * np.pi / 90.0))
    candidates = Candidates(r, z, zero.astype(np.int64), 1.0 + zero, offsets, zero, *x_y)
    cells = ground_plane.lowest_points(candidates)
    assert (cells.z == -0.5).sum() == 36 and (cells.lowest_z == -1.0).all()
    for backend in BACKENDS:
        plane = next(backend.find_planes(candidates, 0.5))
        assert plane.height == pytest.approx(1.0, abs=1e-6)
        assert plane.n_support == len(cells.z)


@settings(max_examples=fewer(20, 10))
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1.0))
def test_backends_agree_on_the_score_of_a_plane(seed, share):
    rng = np.random.default_rng(seed)
    cells = ground_plane.lowest_points(random_candidates(seed, 60, 30, share))
    planes = np.column_stack([rng.uniform(-1.0, 2.5, 20), *rng.normal(0.0, 0.05, (2, 20))])
    scored = planes, cells, cells.weight
    supports, theirs = (module.supports_of(*scored) for module in (ground_plane, compiled))
    np.testing.assert_allclose(theirs, supports, rtol=1e-12)
    refutations = [ground_plane.refutation_of(tuple(plane), cells) for plane in planes.tolist()]
    # The plane with the best score is found without the refutation of each.
    scores = np.square(supports) / np.maximum(np.add(supports, refutations), 1.0)
    best, score, support = ground_plane.best_of(planes, cells, cells.weight, 0.0)
    if score == 0.0:
        assert max(supports) == 0.0
        return
    k = planes.tolist().index(list(best))
    np.testing.assert_allclose((score, support), (scores.max(), supports[k]), rtol=1e-12)
    assert scores[k] == pytest.approx(scores.max(), rel=1e-12)
    assert ground_plane.best_of(planes, cells, cells.weight, score)[1] == 0.0


@pytest.mark.parametrize('backend', BACKENDS, ids=lambda b: b.name)
def test_no_plane(backend):
    few = random_candidates(0, 1, 40, 1.0).first(MIN_CELLS - 1)
    above = random_candidates(1, 90, 20, 1.0)
    few = few._replace(offsets=np.array([0, MIN_CELLS - 1]))
    assert list(backend.find_planes(few, 0.5)) == []
    assert next(backend.find_planes(above, 0.5)).n_support > 0
    # Nothing lies where the ground may be.
    assert list(backend.find_planes(above._replace(z=np.full(len(above.z), 6.0)), 0.5)) == []


def test_moments_that_determine_no_plane_or_no_slope():
    before = 1.5, 0.1, -0.2
    assert solve_plane((0.0,) * 9, before) == before
    one = 1.0, 2.0, 3.0, 4.0, 6.0, 9.0, -1.0, -2.0, -3.0
    assert solve_plane(one, before) == pytest.approx((1.0 + 0.2 - 0.6, 0.1, -0.2))
