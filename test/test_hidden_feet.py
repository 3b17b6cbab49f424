import dataclasses

import numpy as np
import pytest
from conftest import sharing
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.compiled.workspace import Workspace
from gp_ground_seg.frame import Faces, Label, Tiles
from gp_ground_seg.gp.numpy_backend import NumpyBackend
from gp_ground_seg.parameters.config import FacesConfig, GridConfig, LabelConfig
from gp_ground_seg.pipeline.faces import find_faces
from gp_ground_seg.pipeline.labelling import label_points
from gp_ground_seg.pipeline.points import in_columns
from gp_ground_seg.pipeline.polar_grid import build_polar_grid, ground_candidates, reduce_cells
from gp_ground_seg.pipeline.tiles import build_tiles

GRID = GridConfig(r_max=30.0)
CORNER = np.array([10.0, 5.0, 0.0])
"""Of the tile that the clouds below lie in."""


def wall(low=0.0, high=1.5, turn=0.3):
    """Rings of returns on an upright plane, evenly spread over its height."""
    along, z = (
        a.ravel() for a in np.meshgrid(np.linspace(-0.2, 0.2, 9), np.arange(low, high, 0.05))
    )
    x, y = 0.25 + along * np.cos(turn), 0.25 + along * np.sin(turn)
    return np.column_stack([x, y, z]) + CORNER


def ring(away, n=9, turn=0.3):
    """Returns of level ground, so far before that wall."""
    along = np.linspace(-0.1, 0.1, n)
    x = 0.25 + along * np.cos(turn) - away * np.sin(turn)
    y = 0.25 + along * np.sin(turn) + away * np.cos(turn)
    return np.column_stack([x, y, np.zeros(n)]) + CORNER


def is_footless(xyz, **changes):
    tiles = build_tiles(xyz, build_polar_grid(xyz, GRID), FacesConfig().cell_size)
    faces = find_faces(xyz, tiles, FacesConfig(**changes), 2.0)
    assert faces.is_face[tiles.tile].all()
    return bool(faces.is_footless[tiles.tile[0]])


def test_a_wall_down_to_its_lowest_return_hides_its_foot():
    for turn in np.linspace(0.0, np.pi, 7):
        assert is_footless(wall(turn=turn))


@pytest.mark.parametrize(('away', 'hides'), [(0.0, True), (0.02, True), (0.15, False)])
def test_ground_lies_off_the_plane_of_the_wall(away, hides):
    assert is_footless(np.vstack([wall(low=0.1), ring(away, n=30)])) == hides


@pytest.mark.parametrize(('n', 'hides'), [(9, True), (200, False)])
def test_ground_piles_up_at_one_height(n, hides):
    cloud = np.vstack([wall(low=0.15), ring(0.0, n=n)])
    assert is_footless(cloud) == hides
    assert is_footless(cloud, max_foot_density=1000.0)


def test_no_distance_is_small_enough_at_zero():
    assert not is_footless(wall(turn=0.0), max_foot_distance=0.0)


def test_of_a_face_that_hides_its_foot_nothing_is_ground():
    z = np.array([-0.02, 0.0, 0.05])
    grid = build_polar_grid(np.column_stack([[5.0] * 3, [0.0] * 3, z]), GRID)
    smooth = np.zeros((grid.n_segments, grid.n_bins))
    yes, no = np.array([True]), np.array([False])
    for footless, expected in ((no, Label.GROUND), (yes, Label.OBSTACLE)):
        faces = Faces(
            Tiles(np.zeros(3, dtype=np.int32), z[[[0, 2]]], np.zeros(1, dtype=np.int32)),
            yes,
            footless,
        )
        labels, margin = label_points(z, z, grid, faces, smooth, LabelConfig(), 0.1)
        assert list(labels) == [expected] * 3
        assert ((margin >= 0.0) == (expected == Label.GROUND)).all()


def test_lowest_points_on_such_faces_are_no_candidates():
    free = np.array([[10.1, -5.0, -1.0]])
    xyz = np.vstack([wall(), free])
    grid = build_polar_grid(xyz, GRID)
    tiles = build_tiles(xyz, grid, FacesConfig().cell_size)
    candidates = ground_candidates(reduce_cells(grid, xyz[:, 2], tiles.tile), grid.edges, 0.1)
    faces = find_faces(xyz, tiles, FacesConfig(), 2.0)
    on_face = faces.is_footless[candidates.tile]
    assert on_face.any()
    assert not on_face[candidates.segment == grid.segment[-1]].any()
    kept = candidates.where(~on_face)
    assert kept.offsets[-1] == len(kept.r) == len(kept.density) == (~on_face).sum()
    np.testing.assert_array_equal(kept.segment, candidates.segment[~on_face])
    np.testing.assert_array_equal(kept.z, candidates.z[~on_face])


def test_a_wall_seen_over_an_obstacle_is_no_ground():
    rng = np.random.default_rng(4)
    azimuth = rng.uniform(-np.pi, np.pi, 20_000)
    r = rng.uniform(2.0, 25.0, 20_000)
    near = r < 12.0
    ground = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), np.full(len(r), -1.7)])
    # Ahead, a hedge at 12 m hides the ground behind it and the lowest decimetre of a wall.
    ahead = (np.abs(azimuth) < 0.4) & ~near
    y, z = rng.uniform(-4.0, 4.0, 8000), rng.uniform(-1.6, 0.5, 8000)
    facade = np.column_stack([np.full(8000, 16.2), y, z]) + rng.normal(0.0, 0.01, (8000, 3))
    scan = np.vstack([ground[~ahead], facade])
    behind = np.arange(len(scan)) >= (~ahead).sum()
    taken = {}
    for distance in (FacesConfig().max_foot_distance, 0.0):
        config = Config().replace(**{'faces.max_foot_distance': distance, 'sensor.height': 1.7})
        label = GroundSegmenter(config).segment(scan).label
        assert (label[~behind] == Label.GROUND).mean() > 0.99
        taken[distance] = (label[behind] == Label.GROUND).mean()
    assert taken[0.0] > 0.01
    assert taken[FacesConfig().max_foot_distance] < 0.2 * taken[0.0]


@settings(deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([np.float32, np.float64]), st.integers(1, 3))
def test_compiled_marks_are_the_reference(seed, dtype, n_threads):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-12, 12, (300, 3))
    xyz[:, 2] *= 0.1
    xyz[100:250, :2] = np.repeat(xyz[100:115, :2], 10, axis=0) + rng.normal(0, 0.05, (150, 2))
    xyz[::20] = np.nan
    xyz = in_columns(xyz.astype(dtype), Workspace())
    config = Config().replace(**{'faces.max_foot_distance': rng.uniform(0.02, 0.2)})
    config = dataclasses.replace(config, grid=GRID)
    with sharing(n_threads) as backend:
        faces = backend.sort_points(xyz, config, Workspace()).find_faces()
    same = NumpyBackend().sort_points(xyz, config, Workspace()).find_faces()
    np.testing.assert_array_equal(faces.is_face, same.is_face)
    np.testing.assert_array_equal(faces.is_footless, same.is_footless)
