import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.frame import OUTSIDE
from gp_ground_seg.parameters.config import FacesConfig, GridConfig
from gp_ground_seg.pipeline.faces import find_faces, uprightness
from gp_ground_seg.pipeline.polar_grid import build_polar_grid
from gp_ground_seg.pipeline.tiles import build_tiles

GRID = GridConfig(r_max=30.0)


def faces_of(xyz, **changes):
    xyz = np.asarray(xyz, dtype=float)
    grid = build_polar_grid(xyz, GRID)
    config = FacesConfig(**changes)
    tiles = build_tiles(xyz, grid, config.cell_size)
    found = find_faces(xyz, tiles, config, 2.0)
    return found.is_face[np.maximum(tiles.tile, 0)] & (tiles.tile != OUTSIDE), tiles


def plane(normal_z, rng, size=0.5, n=200, corner=(10.0, 5.0)):
    """Points of a plane that rises along x, filling one tile."""
    slope = np.sqrt(1.0 - normal_z**2) / normal_z
    x = rng.uniform(0.01, size - 0.01, n)
    y = rng.uniform(0.01, size - 0.01, n)
    return np.column_stack([corner[0] + x, corner[1] + y, slope * x])


@pytest.mark.parametrize(('normal_z', 'is_face'), [(0.3, True), (0.44, True), (0.5, False)])
def test_faces_are_told_by_their_slope(normal_z, is_face):
    found, _ = faces_of(plane(normal_z, np.random.default_rng(1)))
    assert found.all() if is_face else not found.any()


def test_a_wall_of_any_direction_is_a_face_and_its_foot_is_known():
    rng = np.random.default_rng(2)
    for turn in np.linspace(0.0, np.pi, 9):
        along = rng.uniform(-0.2, 0.2, 100)
        z = rng.uniform(-1.6, 0.0, 100)
        wall = np.column_stack([10.25 + along * np.cos(turn), 5.25 + along * np.sin(turn), z])
        found, tiles = faces_of(wall)
        assert found.all()
        assert tiles.extremes[tiles.tile[0], 0] == z.min()
        assert tiles.extremes[tiles.tile[0], 1] == z.max()


def test_low_flat_and_overhanging_returns_are_no_faces():
    rng = np.random.default_rng(3)
    x, y = rng.uniform(10.0, 10.5, (2, 60))
    assert not faces_of(np.column_stack([x, y, rng.uniform(0.0, 0.49, 60)]))[0].any()
    assert not faces_of(np.column_stack([x, y, np.zeros(60)]))[0].any()
    # A branch over flat ground.
    assert not faces_of(np.column_stack([x, y, np.where(x > 10.25, 3.0, 0.0)]))[0].any()


def test_three_returns_have_no_orientation():
    post = np.array([[10.2, 5.2, z] for z in (0.0, 0.5, 1.0, 1.5)])
    assert faces_of(post + np.eye(4, 3) * 0.01)[0].all()
    assert not faces_of(post[:3] + np.eye(3) * 0.01)[0].any()


def test_points_outside_the_grid_belong_to_no_tile():
    found, tiles = faces_of([[50.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [5.0, 5.0, 0.0]])
    assert list(tiles.tile[:2]) == [OUTSIDE, OUTSIDE]
    assert not found.any()


@settings(deadline=None)
@given(st.integers(0, 100_000))
def test_uprightness_is_the_weighted_normal_of_the_eigenvectors(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(6, 8, 3)) * rng.uniform(0.01, 1.0, 3)
    scatter = np.array([np.cov(cloud.T) * 7 for cloud in points])
    value, vector = np.linalg.eigh(scatter)
    weight = 1.0 / value
    expected = np.sqrt((weight * vector[:, 2, :] ** 2).sum(axis=1) / weight.sum(axis=1))
    np.testing.assert_allclose(uprightness(scatter), expected, rtol=1e-6)


def test_uprightness_of_nothing_is_level():
    np.testing.assert_array_equal(uprightness(np.zeros((2, 3, 3))), 1.0)
