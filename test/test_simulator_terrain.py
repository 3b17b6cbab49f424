"""Terrain and ray caster against closed forms, a scalar oracle and dense sampling."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.simulation import terrain as landforms
from gp_ground_seg.simulation.raycast import first_hit
from gp_ground_seg.simulation.terrain import polyline

MAX_RANGE = 60.0

TERRAINS = {
    'flat': landforms.flat(0.3),
    'slope': landforms.slope(0.2, 0.7),
    'ramp': landforms.ramp(9.0, 0.15, 0.2),
    'kerb': landforms.kerb(4.0, 0.15),
    'kerb_vertical': landforms.kerb(4.0, 0.15, face_width=0.0),
    'ditch': landforms.ditch(0.3, 8.0, 4.0, 1.5, 1.0),
    'crest': landforms.crest(8.0, 10.0, 0.1, 6.0),
    'rough': landforms.rough(np.random.default_rng(3), rms=0.2, wavelengths=(0.7, 9.0)),
    'road_then_rubble': landforms.smooth_then_rough(np.random.default_rng(4), 9.0, 3.0),
    'sum': landforms.kerb(4.0, 0.15, face_width=0.0)
    + landforms.crest(5.0, 10.0, 0.08, 6.0, heading=0.4)
    + landforms.smooth_then_rough(np.random.default_rng(5), 6.0, 2.0, rms=0.05),
}


@pytest.fixture(params=TERRAINS, scope='module')
def terrain(request):
    return TERRAINS[request.param]


def random_rays(rng, n, lowest=-0.5, highest=0.1):
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), rng.uniform(lowest, highest, n)
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def clearance(terrain, origin, direction, t):
    x, y, z = (origin[k] + t * direction[:, k, None] for k in range(3))
    return z - terrain.height(x, y)


def test_hit_is_the_first_crossing(terrain):
    """On the surface, and a fine sampling of the way there finds no earlier crossing."""
    rng = np.random.default_rng(0)
    direction = random_rays(rng, 200)
    position = np.array([0.0, 0.0, float(terrain.height(0.0, 0.0)) + 1.73])
    t = first_hit(terrain, np.tile(position, (200, 1)), direction, MAX_RANGE)
    way = np.minimum(t, MAX_RANGE)[:, None] - 1e-7
    above = clearance(terrain, position, direction, way * np.linspace(0.0, 1.0, 3000))
    assert above.min() > -1e-8
    hit = np.isfinite(t)
    assert 50 < hit.sum() < 200
    ahead = clearance(terrain, position, direction[hit], t[hit, None] + 1e-7)
    behind = clearance(terrain, position, direction[hit], t[hit, None] - 1e-7)
    # At a vertical face the ray goes from well above to well below.
    on_surface = np.abs(behind) < 1e-6
    through_face = (behind > 0.0) & (ahead <= 0.0)
    assert (on_surface | through_face).all()
    assert (ahead < 1e-6).all()


def test_grazing_rays_meet_the_first_wave(terrain):
    """Rays nearly along the ground: each is settled as a sampling at 1 mm settles it."""
    rng = np.random.default_rng(1)
    direction = random_rays(rng, 40, -0.06, 0.02)
    position = np.array([0.0, 0.0, float(terrain.height(0.0, 0.0)) + 0.7])
    t = first_hit(terrain, np.tile(position, (40, 1)), direction, 30.0)
    samples = np.arange(0.0, 30.0, 1e-3)
    below = clearance(terrain, position, direction, samples) <= 0.0
    sampled = np.where(below.any(axis=1), samples[below.argmax(axis=1)], np.inf)
    later = np.minimum(sampled, 30.0) - np.minimum(t, 30.0)
    assert later.min() > -1e-9
    # A sampling steps over a crest that a ray only shaves; such a hit must be on the surface.
    shaved = later > 1.001e-3
    np.testing.assert_allclose(
        clearance(terrain, position, direction[shaved], t[shaved, None]), 0.0, atol=1e-6
    )


@given(
    gradient=st.floats(-0.5, 0.5),
    heading=st.floats(-math.pi, math.pi),
    height=st.floats(0.1, 5.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_plane_is_exact(gradient, heading, height, seed):
    direction = random_rays(np.random.default_rng(seed), 50, -1.4, 0.6)
    plane = landforms.slope(gradient, heading)
    t = first_hit(plane, np.tile([0.0, 0.0, height], (50, 1)), direction, 120.0)
    rise = gradient * (direction[:, 0] * math.cos(heading) + direction[:, 1] * math.sin(heading))
    with np.errstate(divide='ignore'):
        exact = height / (rise - direction[:, 2])
    reached = (exact > 0.0) & (exact <= 120.0)
    near_limit = np.abs(exact - 120.0) < 1e-6
    assert ((reached == np.isfinite(t)) | near_limit).all()
    both = reached & np.isfinite(t)
    np.testing.assert_allclose(t[both], exact[both], rtol=0.0, atol=1e-6)


def crossing_with_chain(points, slope_after, origin_z, dx, dz):
    """Scalar oracle: nearest intersection of a ray from (0, origin_z) with a chain of segments."""
    chain = [
        (-200.0, points[0][1]),
        *points,
        (200.0, points[-1][1] + slope_after * (200.0 - points[-1][0])),
    ]
    best = math.inf
    for (u0, z0), (u1, z1) in itertools.pairwise(chain):
        du, dh = u1 - u0, z1 - z0
        determinant = dx * dh - dz * du
        if abs(determinant) < 1e-15:
            continue
        along_ray = (u0 * dh - (z0 - origin_z) * du) / determinant
        along_segment = (u0 * dz - (z0 - origin_z) * dx) / determinant
        if along_ray > 0.0 and -1e-12 <= along_segment <= 1.0 + 1e-12:
            best = min(best, along_ray)
    return best


@settings(max_examples=300, deadline=None)
@given(
    gaps=st.lists(st.sampled_from([0.0, 0.01, 0.3, 2.0, 7.0]), min_size=1, max_size=6),
    heights=st.lists(st.sampled_from([-1.0, -0.15, 0.0, 0.15, 0.8]), min_size=7, max_size=7),
    slope_after=st.sampled_from([-0.2, 0.0, 0.1]),
    elevation=st.floats(-1.2, 0.3),
)
def test_polyline_agrees_with_scalar_oracle(gaps, heights, slope_after, elevation):
    """Kinks and vertical steps in any order, against a segment-by-segment intersection."""
    points = [(3.0 + sum(gaps[:k]), heights[k]) for k in range(len(gaps) + 1)]
    # A surface has no spike of no width: of several corners above each other, the first and
    # the last are its two sides.
    points = [
        corner
        for k, corner in enumerate(points)
        if k in (0, len(points) - 1)
        or points[k - 1][0] < corner[0]
        or corner[0] < points[k + 1][0]
    ]
    ground = polyline(0.0, points, slope_after=slope_after)
    dx, dz = math.cos(elevation), math.sin(elevation)
    t = first_hit(ground, np.array([[0.0, 0.0, 1.7]]), np.array([[dx, 0.0, dz]]), 60.0)[0]
    # A ray through a corner may pass or touch it. A higher ray never hits earlier, so rays a hair
    # below and above enclose the answer; away from corners they leave it no room.
    earliest, latest = (
        crossing_with_chain(points, slope_after, 1.7 + hair, dx, dz) for hair in (-1e-8, 1e-8)
    )
    assert earliest - 1e-6 <= t
    assert t <= latest + 1e-6 if latest <= 60.0 - 1e-6 else t <= 60.0 or t == math.inf


@pytest.mark.parametrize(
    ('elevation', 'y', 'across', 'expected'),
    [
        # Onto the face, 7 cm above the road; along the road.
        (-math.atan2(1.73 - 0.07, 4.0), 0.0, 1.0, [0.0, 4.0, 0.07]),
        (-0.1, 1.0, 0.0, [1.73 / math.tan(0.1), 1.0, 0.0]),
    ],
)
def test_vertical_kerb_is_exact(elevation, y, across, expected):
    kerb = landforms.kerb(4.0, 0.15, face_width=0.0)
    flat = math.cos(elevation)
    direction = np.array([[flat * (1.0 - across), flat * across, math.sin(elevation)]])
    origin = np.array([[0.0, y, 1.73]])
    t = first_hit(kerb, origin, direction, 120.0)
    np.testing.assert_allclose((origin + t * direction)[0], expected, atol=1e-9)


def test_crest_hides_the_descent():
    """No level or falling ray from below reaches the ground behind the top."""
    crest = landforms.crest(8.0, 10.0, 0.3, 4.0)
    direction = random_rays(np.random.default_rng(2), 500, -0.4, 0.0)
    direction = direction[direction[:, 0] > 0.5]
    t = first_hit(crest, np.tile([0.0, 0.0, 1.73], (len(direction), 1)), direction, 120.0)
    x = t * direction[:, 0]
    assert (x[np.isfinite(x)] < 20.0).all()


def test_slope_and_bend_bound_hold(terrain):
    """Slope equals a central difference; no second difference exceeds the bend bound."""
    rng = np.random.default_rng(6)
    at = rng.uniform(-30.0, 30.0, (2000, 2))
    heading = rng.uniform(-np.pi, np.pi, 2000)
    direction = np.column_stack([np.cos(heading), np.sin(heading)])
    step = 1e-4
    here = terrain.along(at, direction)
    before = terrain.along(at - step * direction, direction, at).height
    after = terrain.along(at + step * direction, direction, at).height
    np.testing.assert_allclose(here.slope, (after - before) / (2.0 * step), atol=1e-6)
    axes = terrain.gradient(at)
    np.testing.assert_allclose(np.sum(axes * direction, axis=1), here.slope, atol=1e-9)
    second = (after - 2.0 * here.height + before) / step**2
    assert (second <= here.bend + 1e-5).all()


def test_ceiling_is_never_below(terrain):
    x, y = np.random.default_rng(7).uniform(-40.0, 40.0, (2, 5000))
    assert (terrain.ceiling().height(x, y) >= terrain.height(x, y) - 1e-12).all()


def test_sum_adds_heights():
    x, y = np.random.default_rng(8).uniform(-30.0, 30.0, (2, 100))
    parts = [TERRAINS[name] for name in ('slope', 'ditch', 'rough')]
    total = parts[0] + parts[1] + parts[2]
    expected = sum(part.height(x, y) for part in parts)
    np.testing.assert_allclose(total.height(x, y), expected, atol=1e-12)


@pytest.mark.parametrize(
    ('terrain', 'u', 'expected'),
    [
        (landforms.kerb(4.0, 0.15, 0.1, 0.0), [-9, -3.9, 0, 4.05, 4.2], [0.15, 0, 0, 0.075, 0.15]),
        (
            landforms.ditch(0.0, 10.0, 4.0, 2.0, 1.0),
            [9, 10.5, 12, 13.5, 15],
            [0, -0.5, -1, -0.5, 0],
        ),
        (landforms.ramp(10.0, 0.1), [9, 20], [0, 1]),
        (landforms.crest(10.0, 10.0, 0.1, 4.0), [10, 20, 22, 24, 34], [0, 1, 1.1, 1, 0]),
    ],
)
def test_landform_heights(terrain, u, expected):
    np.testing.assert_allclose(terrain.height(np.array(u), np.zeros(len(u))), expected, atol=1e-12)


def test_waves_have_the_rms_asked_for():
    ground = landforms.rough(np.random.default_rng(9), 0.1, (1.0, 8.0), 12, landforms.flat(1.0))
    x, y = np.random.default_rng(10).uniform(-2000.0, 2000.0, (2, 50_000))
    assert np.std(ground.height(x, y)) == pytest.approx(0.1, rel=0.03)


def test_rubble_starts_where_the_road_ends():
    ground = landforms.smooth_then_rough(np.random.default_rng(11), 20.0, 5.0, rms=0.15)
    x, y = np.random.default_rng(12).uniform(-50.0, 20.0, (2, 1000))
    assert not ground.height(x, y).any()
    assert np.std(ground.height(x + 120.0, y)) > 0.1


@pytest.mark.parametrize(
    'envelope',
    [
        landforms.slope(0.1),
        polyline(0.0, [(0.0, 1.0), (5.0, -1.0), (6.0, 0.0)]),
        landforms.flat(-1.0),
        landforms.crest(1.0, 2.0, 0.1, 2.0),
    ],
)
def test_waves_refuse_an_envelope_they_cannot_bound(envelope):
    with pytest.raises(ConfigError, match='envelope'):
        landforms.rough(np.random.default_rng(0), 0.1, (1.0, 2.0), 2, envelope)


def test_bad_values_are_refused():
    for points in ([], [(1.0, 0.0), (0.0, 0.0)]):
        with pytest.raises(ConfigError, match='ascending'):
            polyline(0.0, points)
    for values in ((-0.1, (1.0, 2.0), 2), (0.1, (0.0, 2.0)), (0.1, (3.0, 2.0)), (1, (1, 2), 0)):
        with pytest.raises(ConfigError, match='waves: rms'):
            landforms.rough(np.random.default_rng(0), *values)
