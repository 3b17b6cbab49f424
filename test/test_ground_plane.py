"""The plane of the ground near the sensor: both backends on clutter and on anything."""

import numpy as np
import pytest
from conftest import fewer
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.compiled.backend import NumbaBackend
from gp_ground_seg.core.frame import Candidates
from gp_ground_seg.core.pipeline import ground_plane
from gp_ground_seg.core.pipeline.ground_plane import MIN_CELLS, N_SECTORS, RING_EDGES, solve_plane
from gp_ground_seg.core.pipeline.tilt import rotation

BACKENDS = NumpyBackend(), NumbaBackend()
ORIGIN = (0.0, 0.0, 0.0)


def cluttered_plane(seed, height, roll, pitch):
    """Rings on a plane, a third of the directions blocked by obstacles, some noise."""
    rng = np.random.default_rng(seed)
    depression = np.radians(np.arange(2.0, 26.0, 1.0))
    azimuth = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    r = (height / np.tan(depression))[:, None] * np.ones(len(azimuth))
    z = np.full(r.shape, -height)
    obstacle = np.repeat(rng.uniform(2.0, 30.0, 36), 10)
    blocked = (r > obstacle) & np.repeat(rng.random(36) < 0.33, 10)
    z = np.where(blocked, -height * obstacle / r, z)
    r = np.where(blocked, obstacle, r)
    points = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=-1).reshape(-1, 3)
    mirrored = rng.random(len(points)) < 0.01
    points[mirrored] *= rng.uniform(1.0, 2.0, (int(mirrored.sum()), 1))
    return points @ rotation(roll, pitch) + rng.normal(0.0, 0.01, points.shape)


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
    r = np.concatenate(r)
    return Candidates(r, z, own_bin, density, offsets, tile, np.zeros_like(r), np.zeros_like(r))


def slow_lowest(candidates):
    """Sector, z, r and segment of the lowest candidate of each cell, one by one."""
    lowest, n_segments = {}, len(candidates.offsets) - 1
    for m, r, z in zip(candidates.segment, candidates.r, candidates.z, strict=True):
        if RING_EDGES[0] <= r < RING_EDGES[-1] and abs(z) < 65.0:
            ring = sum(r >= edge for edge in RING_EDGES) - 1
            cell = (m * N_SECTORS // n_segments, ring)
            lowest[cell] = min(lowest.get(cell, (np.inf,)), (z, r, m))
    return [(cell[0], *lowest[cell]) for cell in sorted(lowest)]


@settings(max_examples=fewer(60, 10))
@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.integers(0, 40), st.floats(0.0, 1.0))
def test_backends_agree_on_anything(seed, n_segments, n_bins, share):
    origin = tuple(np.random.default_rng(seed).choice([0.0, -1.3, 2.0], 3).tolist())
    candidates = random_candidates(seed, n_segments, n_bins, share)
    cells = ground_plane.lowest_points(candidates)
    cosine, sine = ground_plane.segment_directions(n_segments)
    expected = [(s, z, r, r * cosine[m], r * sine[m]) for s, z, r, m in slow_lowest(candidates)]
    assert list(zip(cells.sector, cells.z, cells.r, cells.x, cells.y, strict=True)) == expected
    a, b = (backend.fit_plane(candidates, 0.577, origin) for backend in BACKENDS)
    assert (a is None) == (b is None)
    if a is not None:
        np.testing.assert_allclose(a, b, atol=1e-9)
        assert 0.0 < a.support <= 1.0
        assert a.n_support <= a.n_cells <= N_SECTORS * ground_plane.N_RINGS


@pytest.mark.parametrize('backend', BACKENDS, ids=lambda b: b.name)
def test_no_plane(backend):
    few = random_candidates(0, 1, 40, 1.0)
    few = few.first(MIN_CELLS - 1)._replace(offsets=np.array([0, MIN_CELLS - 1]))
    assert backend.fit_plane(few, 0.5, ORIGIN) is None
    above = random_candidates(1, 90, 20, 1.0)
    assert backend.fit_plane(above, 0.5, ORIGIN) is not None
    # Nothing lies where the ground may be.
    assert backend.fit_plane(above._replace(z=np.full(len(above.z), 6.0)), 0.5, ORIGIN) is None


def test_moments_that_determine_no_plane_or_no_slope():
    before = 1.5, 0.1, -0.2
    assert solve_plane((0.0,) * 9, before) == before
    x, y = 2.0, 3.0
    one = 1.0, x, y, x * x, x * y, y * y, -1.0, -x, -y
    assert solve_plane(one, before) == pytest.approx((1.0 + 0.1 * x - 0.2 * y, 0.1, -0.2))


def test_a_refinement_that_leaves_the_ground_is_not_used(monkeypatch):
    candidates = BACKENDS[0].build_grid(cluttered_plane(0, 1.5, 0.0, 0.0), Config()).candidates
    monkeypatch.setattr(ground_plane, 'refined', lambda *_: (99.0, 0.0, 0.0))
    assert ground_plane.fit_plane(candidates, 0.5, ORIGIN).height == pytest.approx(1.5, abs=0.1)
    # Nor is a plane that no point lies on.
    monkeypatch.setattr(ground_plane, 'refined', lambda *_: (19.0, 0.0, 0.0))
    assert ground_plane.fit_plane(candidates, 0.5, ORIGIN) is None
