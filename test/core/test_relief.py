"""The relief of the terrain: both backends, and what it does and does not follow."""

import math

import numpy as np
import pytest
from conftest import BACKENDS, fewer
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.core.frame import Candidates, Faces
from gp_ground_seg.core.pipeline.relief import N_SIDES, Relief

HEIGHT, N_TILES = 1.8, 10_000
MIDDLES = 2.0 * np.arange(N_SIDES) - 59.0
NO_FACES = Faces(*np.zeros((3, N_TILES), dtype=bool))


def candidates_on(height, ranges, n_segments=180, seed=0, share=1.0, spread=0.3):
    """Candidates on ground of a `height` over x and y, or a share of them."""
    rng = np.random.default_rng(seed)
    segment, r = np.repeat(np.arange(n_segments), len(ranges)), np.tile(ranges, n_segments)
    kept = rng.uniform(size=len(r)) < share
    segment, r = segment[kept], r[kept]
    turn = (segment + 0.5 + spread * rng.uniform(-1.0, 1.0, len(r))) / n_segments
    azimuth = 2.0 * np.pi * turn - np.pi
    x, y = r * np.cos(azimuth), r * np.sin(azimuth)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(segment, minlength=n_segments))])
    # A tile for each, unless a test has others.
    z, tile = height(x, y) - HEIGHT, np.arange(len(r), dtype=np.int32)
    return Candidates(r, z, np.arange(len(r)), np.ones(len(r)), offsets, tile, x, y)


RINGS = np.concatenate([np.arange(3.0, 20.0, 0.5), np.arange(20.0, 40.0, 1.0)])


@settings(max_examples=fewer(12, 6), deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([4, 45, 90]), st.booleans())
def test_backends_find_one_relief(compiled_code, seed, n_segments, looks_aside):
    rng = np.random.default_rng(seed)
    steep, foot, turn, noise = rng.uniform((0.1, 5.0, -3.0, 0.0), (0.8, 15.0, 3.0, 0.1))
    fall, fall_at = rng.uniform((0.0, 4.0), (4.0, 12.0))

    def terrain(x, y):
        along = x * math.cos(turn) + y * math.sin(turn)
        bank = np.clip(steep * (along - foot), 0.0, 3.0)
        thing = 1.5 * (rng.uniform(size=len(x)) < 0.05)
        below = -fall * (along < -fall_at) - fall * (along < -2.5 * fall_at)
        return bank + below + thing + noise * rng.normal(size=len(x))

    ranges = np.sort(rng.uniform(2.0, 65.0, 24))
    candidates = candidates_on(terrain, ranges, n_segments, seed, share=0.7)
    faces = Faces(*(rng.uniform(size=(3, N_TILES)) < 0.1))
    config = Config().replace(**{'surface.look_aside': looks_aside})
    found = [backend.find_relief(candidates, faces, HEIGHT, config) for backend in BACKENDS]
    np.testing.assert_allclose(found[0][0].pieces, found[1][0].pieces, rtol=1e-7, atol=1e-7)
    np.testing.assert_array_equal(found[0][2], found[1][2])
    for relief, over, _ in found:
        lift = relief.at(candidates.x, candidates.y)
        np.testing.assert_allclose(over.z, candidates.z - lift, rtol=1e-7, atol=1e-7)
        for ours, theirs in zip(over._replace(z=0), candidates._replace(z=0), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def bank(degrees, foot, high=3.0):
    """Terrain that rises from x = `foot` [m] on."""
    return lambda x, y: np.clip(math.tan(math.radians(degrees)) * (x - foot), 0.0, high)


@pytest.mark.parametrize('degrees', [15, 25, 35, -20])
def test_the_relief_is_that_of_a_bank(backend, degrees):
    side = math.copysign(1.0, degrees)
    candidates = candidates_on(lambda x, y: side * bank(abs(degrees), 10.0)(x, y), RINGS)
    relief, over, _ = backend.find_relief(candidates, NO_FACES, HEIGHT, Config())
    missed = over.z + HEIGHT
    assert np.abs(candidates.z + HEIGHT).max() == pytest.approx(3.0)
    assert np.mean(np.abs(missed) < 0.3) > 0.92
    assert np.sqrt(np.mean(missed**2)) < 0.15
    # Behind the last return it stays as high; ground as low as this, and the road, are level.
    far = relief.at(np.array([45.0, 500.0]), np.array([0.0, 20.0]))
    np.testing.assert_allclose(far, 3.0 * side, atol=0.1)
    assert (relief.at(np.array([-30.0, 5.0]), np.zeros(2)) == 0.0).all()


FEW_RINGS = np.concatenate([np.arange(3.0, 10.1, 0.5), np.arange(11.5, 30.0, 2.2)])


@pytest.mark.parametrize(
    ('rings', 'foot', 'first', 'last', 'least'),
    [(FEW_RINGS, 10, -6, 6, 0.92), (RINGS, 18, 16, 48, 0.9)],
)
def test_hillsides_are_climbed_beside_and_in_high_steps(backend, rings, foot, first, last, least):
    seen = candidates_on(bank(25, foot, 6.0), rings)
    seen = seen.where((seen.x < foot) | ((seen.y > first) & (seen.y < last)))
    over = backend.find_relief(seen, NO_FACES, HEIGHT, Config())[1]
    assert np.mean(np.abs(over.z + HEIGHT)[over.x > foot + 4.0] < 0.3) > least


@pytest.mark.parametrize(('at', 'depth', 'share'), [(5, 1.2, 0.95), (7.5, 2, 1), (10, 3, 1)])
def test_terrain_ends_at_an_edge_and_goes_on_below(backend, at, depth, share):
    """What the edge hides is left out: the relief follows the terrain up to it, on both sides."""
    candidates = candidates_on(lambda x, y: np.where(x > at, -depth, 0.0), RINGS)
    seen = at * (HEIGHT + depth) / HEIGHT
    candidates = candidates.where((candidates.x < at) | (candidates.x > seen))
    _, over, _ = backend.find_relief(candidates, NO_FACES, HEIGHT, Config())
    is_below = candidates.x > seen
    assert is_below.sum() > 150
    off = np.abs(over.z + HEIGHT)
    assert off[~is_below].max() < 0.01
    assert np.mean(off[is_below] < 0.05) >= share and off[is_below].max() < 0.2


def box(x0, x1, y0, y1, high):
    """Level ground with a box on it."""
    return lambda x, y: high * ((x > x0) & (x < x1) & (y > y0) & (y < y1))


def plateau(half):
    """Level ground with one on it, so many m wide to each side, that can be climbed."""
    return lambda x, y: np.clip(0.8 * np.minimum(x - 6.0, half - np.abs(y)), 0.0, 0.5) * (x < 9.0)


LEVEL_TERRAIN = {
    'camber': lambda x, y: -0.1 * np.abs(y / 40.0),
    'bonnet': lambda x, y: box(6.0, 10.0, 2.0, 3.8, 0.9)(x, y) * (1.0 - 0.1 * (x - 6.0)),
    'truck': box(8.0, 20.0, 3.0, 5.5, 3.2),
    'pallets': box(5.0, 9.0, -2.0, 2.0, 0.2),
    'hole': box(8.0, 11.0, 0.0, 4.0, -1.5),
    'terrace': lambda x, y: 1.2 * (x > 9.0),
}


@pytest.mark.parametrize('name', LEVEL_TERRAIN)
@pytest.mark.parametrize('share', [1.0, 0.5])
def test_no_relief_is_what_cannot_be_climbed(backend, name, share):
    candidates = candidates_on(LEVEL_TERRAIN[name], RINGS, share=share)
    relief, over, _ = backend.find_relief(candidates, NO_FACES, HEIGHT, Config())
    assert relief.is_level and over is candidates
    assert (relief.at(np.array([0.0, 9.0]), np.array([0.0, 3.0])) == 0.0).all()


STANDING = {
    'bed': (box(6.0, 10.0, -4.0, 4.0, 0.5), True),
    'truck': (LEVEL_TERRAIN['truck'], True),
    'pallets': (LEVEL_TERRAIN['pallets'], False),
    'post': (box(6.0, 6.6, -0.2, 0.2, 0.9), False),
    'terrace': (LEVEL_TERRAIN['terrace'], False),
    'plateau': (plateau(3.0), False),
    'narrow plateau': (plateau(1.6), False),
    'bank': (bank(25, 10.0), False),
    'shelf': (box(0.0, 4.5, -2.0, 2.0, 0.27), True),
}


@pytest.mark.parametrize('name', STANDING)
@pytest.mark.parametrize('per_tile', [1, 2])
def test_what_stands_on_the_ground_has_ground_before_and_behind_it(backend, name, per_tile):
    terrain, stands = STANDING[name]
    candidates = candidates_on(terrain, np.arange(3.0, 20.0, 0.4))
    tile = candidates.tile // per_tile
    faces = backend.find_relief(candidates._replace(tile=tile), NO_FACES, HEIGHT, Config())[2]
    expected = np.full(tile[-1] + 1, stands)
    np.logical_and.at(expected, tile, candidates.z + HEIGHT > 0.25)
    np.testing.assert_array_equal(np.stack(faces[:2])[:, : len(expected)], [expected] * 2)
    assert not NO_FACES.is_face.any()


def test_land_behind_a_gap_between_rings_does_not_stand(backend):
    """A pitched sensor with 16 beams: no step of the allowed length leads to its far rings."""
    rings = np.array([3.0, 3.6, 4.2, 5.0, 6.2, 7.0, 11.0, 18.0, 30.0])
    candidates = candidates_on(lambda x, y: x * box(7.2, 24.0, -6.0, 6.0, 0.045)(x, y), rings)
    assert not backend.find_relief(candidates, NO_FACES, HEIGHT, Config())[2].is_face.any()


def test_no_way_leads_over_returns_that_are_too_steep(backend):
    candidates = candidates_on(STANDING['plateau'][0], np.arange(3.0, 20.0, 0.4))
    over = candidates.z + HEIGHT
    is_steep = np.pad((over > 0.0) & (over < 0.5), (0, N_TILES - len(over)))
    faces = NO_FACES._replace(is_steep=is_steep)
    found = backend.find_relief(candidates, faces, HEIGHT, Config())[2]
    assert found.is_face[: len(over)][over == 0.5].all()


def test_without_ground_near_the_sensor_there_is_no_relief(backend):
    behind = candidates_on(bank(25, 10.0), RINGS[RINGS > 14.0])
    behind = behind.where(behind.x > 13.0)
    for candidates in (behind, behind.where(behind.x > 500.0)):
        assert backend.find_relief(candidates, NO_FACES, HEIGHT, Config())[0].is_level


def test_between_middles_it_is_linear_and_beyond_the_border_constant():
    height = np.random.default_rng(0).normal(size=(N_SIDES, N_SIDES))
    relief = Relief.of(height)
    x, y = (at.ravel() for at in np.meshgrid(MIDDLES, MIDDLES, indexing='ij'))
    np.testing.assert_allclose(relief.at(x, y), height.ravel(), atol=1e-4)
    x, y = MIDDLES[10] + 0.5, MIDDLES[20] + 1.5
    expected = np.array([0.75, 0.25]) @ height[10:12, 20:22] @ np.array([0.25, 0.75])
    found = relief.at(np.array([x, -500.0, 80.0]), np.array([y, MIDDLES[0], 70.0]))
    np.testing.assert_allclose(found, [expected, height[0, 0], height[-1, -1]], atol=1e-4)
    knots = np.array([2.0, 10.0])
    at_knots = relief.at_knots(knots, 4)
    assert at_knots.shape == (4, 2)
    half = math.sqrt(0.5) * knots
    np.testing.assert_allclose(at_knots[2], relief.at(half, half))
