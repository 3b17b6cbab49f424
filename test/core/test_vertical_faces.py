import numpy as np
import pytest
from conftest import BACKENDS, fewer
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.core.frame import OUTSIDE
from gp_ground_seg.core.pipeline.vertical_faces import UNITS_PER_METRE

BASE = Config().replace(**{'grid.r_max': 30.0})
CORNER = np.array([10.0, 5.0, 0.0])
"""Corner of the tile that the clouds below lie in."""


def faces_of(backend, xyz, height=0.0, **changes):
    """Whether each point lies on a face, and on one with occluded base; and the scan."""
    config = BASE.replace(**{f'faces.{name}': value for name, value in changes.items()})
    scan = backend.build_grid(np.asarray(xyz), config)
    faces, tile = backend.find_faces(scan, height, config), np.maximum(scan.tiles.tile, 0)
    inside = scan.tiles.tile != OUTSIDE
    return faces.is_face[tile] & inside, faces.has_occluded_base[tile] & inside, scan


X, Y = np.random.default_rng(3).uniform(0.01, 0.49, (2, 60))
POST = np.outer(np.arange(4), [0.01, 0.0, 0.3]) + [0.2, 0.2, 0.0] + np.eye(4, 3) * 0.01
PLANES = {z: np.column_stack([X, Y, X * np.sqrt(1.0 - z**2) / z]) for z in (0.3, 0.44, 0.5)}
CLOUDS = {
    **{f'normal z {z}': (plane, z < 0.45) for z, plane in PLANES.items()},
    'low': (np.column_stack([X, Y, X]), False),
    'flat': (np.column_stack([X, Y, np.zeros(60)]), False),
    'branch over flat ground': (np.column_stack([X, Y, np.where(X > 0.25, 3.0, 0.0)]), False),
    'post': (POST, True),
    'three returns': (POST[:3], False),
    'beyond the grid': (np.add(POST, [50.0, 0.0, 0.0]), False),
    'a vertical line': (POST * [0.0, 0.0, 1.0], False),
    'a leaning line': (np.outer(np.arange(9), [0.01, 0.02, 0.1]) + 0.1, False),
    'not finite': (POST * np.nan, False),
}


@pytest.mark.parametrize('name', CLOUDS)
def test_what_is_a_face(backend, name):
    xyz, is_face = CLOUDS[name]
    assert (faces_of(backend, CORNER + xyz)[0] == is_face).all()


def test_returns_above_one_place_have_no_direction(backend):
    """The torture campaign's: their scatter is rounding, whose direction differed by backend."""
    for x, place, *y in np.random.default_rng(0).uniform(0.01, 0.49, (fewer(60, 20), 62)):
        foot = np.column_stack([np.full(60, x), y, np.linspace(0.0, 0.09, 60)])
        above = [[x, place, z] for z in (0.5, 0.52, 0.55)]
        is_face, is_occluded, _ = faces_of(backend, CORNER + np.vstack([foot, above]))
        assert is_face.all() and not is_occluded.any()


@pytest.mark.parametrize(('slope', 'is_steep'), [(0.7, False), (1.0, True), (4.0, True)])
@pytest.mark.parametrize('foliage', [0.0, 0.02])
def test_what_is_too_steep_for_terrain(backend, slope, is_steep, foliage):
    """Foliage scatters the returns along the beams, which changes their slope little."""
    rng = np.random.default_rng(0)
    z = rng.uniform(0.0, 0.4 * min(slope, 1.0), 200)
    x = np.minimum(z / slope + foliage * rng.exponential(size=200), 0.49)
    xyz = np.column_stack([x, rng.uniform(0.01, 0.49, 200), z])
    scan = backend.build_grid(CORNER + xyz, BASE)
    assert (backend.find_faces(scan, 0.0, BASE).is_steep[scan.tiles.tile] == is_steep).all()


def test_a_face_below_an_edge_shows_no_ground(backend):
    face = CORNER + PLANES[0.3] - [0.0, 0.0, 1.0]
    before = face * [0.85, 0.85, 0.0] - [0.0, 0.0, 1.0]
    for xyz, is_beyond in ((face, True), (np.vstack([before, face]), False)):
        is_face, is_occluded, _ = faces_of(backend, xyz, max_foot_distance=0.0)
        assert is_face[-60:].all() and (is_occluded[-60:] == is_beyond).all()


@pytest.mark.parametrize(('first', 'height', 'top'), [(-29, 0.5, 1), (-5, 0.5, 0), (-29, 0, 0)])
def test_what_rays_pass_on_both_sides_below_an_edge_is_a_top(backend, first, height, top):
    azimuth = np.radians(np.arange(first, 30, 2))  # in the middle of each segment
    r = np.where(np.abs(azimuth) < 0.1, 10.0, 25.0)
    xyz = r * [np.cos(azimuth), np.sin(azimuth), np.full_like(azimuth, -0.1)]
    assert (faces_of(backend, xyz.T, height)[0] == (top & (r < 20.0))).all()


@settings(max_examples=fewer(30, 10))
@given(st.integers(0, 10_000), st.sampled_from([np.float32, np.float64]))
def test_backends_find_the_same_faces(compiled_code, seed, dtype):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-12, 12, (300, 3)) * [1.0, 1.0, 0.1]
    xyz[100:250, :2] = np.repeat(xyz[100:115, :2], 10, axis=0) + rng.normal(0, 0.05, (150, 2))
    # A threshold may lie between a coordinate and what it is rounded to.
    xyz = np.rint(xyz * UNITS_PER_METRE) / UNITS_PER_METRE
    xyz[::20] = np.nan
    limit = (0.45, 0.45, 0.0, 1.0)[seed % 4]
    changes = {'max_foot_distance': rng.uniform(0.02, 0.2), 'max_normal_z': limit}
    ours, theirs = (
        faces_of(backend, xyz.astype(dtype), (0.0, 0.5, 1.0)[seed % 3], **changes)
        for backend in BACKENDS
    )
    np.testing.assert_array_equal(ours[:2], theirs[:2])
    assert ours[0].any() or limit == 0.0


def patch(y, height, noise, rise=0.0, apart=0.0):
    """Returns on 2 by 2 m from y on with noise, and steps along x; in rings so far `apart`."""
    rng = np.random.default_rng(8)
    x, z = rng.uniform(0.0, 2.0, 800), height + rng.normal(0.0, noise, 800)
    y = rng.uniform(y, y + 2.0, 800)
    if apart > 0.0:
        x = (x // apart * apart + 0.3 * y) % 2.0
    return np.stack([x, y, z + rise * np.floor(x / 0.3)], axis=-1)


@pytest.mark.parametrize(
    ('own', 'what', 'shows_none'),
    [
        (0.005, (0.6, 0.04, 0.0, 0.0), True),  # a bush
        (0.005, (0.6, 0.01, 0.0, 0.0), False),  # a bank
        # Stairs, and such of which a tile shows one step or none.
        *((0.005, (0.6, std, 0.16, apart), True) for std in (0.0, 0.003) for apart in (0.0, 0.53)),
        (0.005, (0.2, 0.04, 0.0, 0.0), False),  # tall grass
        (0.005, (-0.6, 0.04, 0.0, 0.0), False),  # a bed below the own level
        (0.03, (0.6, 0.04, 0.0, 0.0), False),  # land that scatters as the own level does
    ],
)
def test_raised_tiles_that_scatter_show_no_ground(backend, own, what, shows_none):
    level, raised = patch(0.0, 0.0, own), patch(6.0, *what)
    _, is_occluded, _ = faces_of(backend, np.vstack([level, raised]))
    assert not is_occluded[: len(level)].any()
    assert is_occluded[len(level) :].mean() > 0.9 if shows_none else not is_occluded.any()


def test_rings_in_the_plane_of_their_rays_do_not_make_rough_land_smooth(backend):
    rings = [patch(-4.0 * k, 0.0, 0.0) for k in range(1, 5)]
    level, raised = patch(0.0, 0.0, 0.03), patch(6.0, 0.6, 0.04)
    assert not faces_of(backend, np.vstack([level, *rings, raised]))[1].any()
