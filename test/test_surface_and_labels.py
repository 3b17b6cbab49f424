import dataclasses

import numpy as np
import pytest
import scipy.stats
from conftest import sharing
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.compiled.workspace import Workspace
from gp_ground_seg.frame import Faces, GroundSurface, Label, Tiles
from gp_ground_seg.gp.numpy_backend import NumpyBackend
from gp_ground_seg.parameters.config import Config, GridConfig, LabelConfig
from gp_ground_seg.pipeline.labelling import (
    LabelTask,
    ground_probability,
    label_points,
    local_roughness,
    stands_in_bin,
)
from gp_ground_seg.pipeline.points import in_columns
from gp_ground_seg.pipeline.polar_grid import build_polar_grid
from gp_ground_seg.pipeline.surface import fuse_neighbours, fuse_rows
from gp_ground_seg.segmenter import GroundSegmenter

GRID = GridConfig(n_segments=4, n_bins=4, r_min=2.0, r_max=10.0, bin_growth=1.0)
KNOTS = np.array([2.0, 4.0, 6.0, 8.0, 10.0])


def grid_of(*ranges, angle=0.1):
    xyz = np.array([[r * np.cos(angle), r * np.sin(angle), 0.0] for r in ranges])
    return build_polar_grid(xyz, GRID)


def surface_of(heights):
    mean = np.tile(np.asarray(heights, dtype=float), (4, 1))
    return GroundSurface(KNOTS, mean, np.full((4, 5), 0.1), np.ones(0, dtype=bool))


def test_surface_is_linear_between_knots_and_constant_before_the_first():
    heights, stds = surface_of([0.0, 2.0, 2.0, 1.0, 0.0]).at(grid_of(0.5, 2.0, 3.0, 4.0, 9.5))
    np.testing.assert_allclose(heights, [0.0, 0.0, 1.0, 2.0, 0.25])
    np.testing.assert_allclose(stds, 0.1)


def test_no_surface_beyond_the_last_knot_or_without_a_model():
    surface = surface_of([0.0] * 5)
    assert np.isnan(surface.at(grid_of(10.0, 1e6, np.nan))[0]).all()
    surface.mean[grid_of(5.0).segment] = np.nan
    assert np.isnan(surface.at(grid_of(5.0))[0]).all()


def test_fusing_equal_surfaces_changes_no_height_and_is_surer():
    mean, std = np.full((6, 5), 0.3), np.full((6, 5), 0.1)
    fused, fused_std = fuse_neighbours(mean, std, KNOTS, 2, 0.05)
    np.testing.assert_allclose(fused, 0.3)
    assert (fused_std < std).all()


def test_fusing_weighs_by_certainty_and_distance():
    mean, std = np.zeros((8, 5)), np.full((8, 5), 0.1)
    mean[3] = 1.0
    fused, _ = fuse_neighbours(mean, std, KNOTS, 1, 0.1)
    aside = 0.1 * KNOTS * 2 * np.pi / 8
    weights = np.array([1 / (0.1**2 + aside**2), np.full(5, 1 / 0.1**2)])
    np.testing.assert_allclose(fused[3], weights[1] / (weights[1] + 2 * weights[0]))
    assert (np.diff(fused[3]) > 0).all()
    np.testing.assert_array_equal(fused[6], 0.0)


def test_a_segment_without_a_model_gets_its_neighbours():
    mean, std = np.full((8, 5), 0.4), np.full((8, 5), 0.1)
    mean[:4] = std[:4] = np.nan
    fused, fused_std = fuse_neighbours(mean, std, KNOTS, 1, 0.05)
    np.testing.assert_allclose(fused[[0, 3]], 0.4)
    assert (fused_std[[0, 3]] > 0.1).all()
    assert np.isnan(fused[1:3]).all()
    same = fuse_neighbours(mean, std, KNOTS, 0, 0.05)
    np.testing.assert_array_equal(same[0], mean)


def faces_in(tile, foot_z, is_face):
    return Faces(
        Tiles(tile, np.column_stack([foot_z, foot_z + 1.0]), np.unique(tile)),
        is_face,
        np.zeros_like(is_face),
    )


def nothing_stands(n):
    return faces_in(np.zeros(n, dtype=np.int32), np.zeros(1), np.zeros(1, dtype=bool))


def labels_of(heights, grid, roughness=0.0, config=None, faces=None, z=None):
    heights = np.asarray(heights, dtype=float)
    return label_points(
        heights if z is None else np.asarray(z, dtype=float),
        heights,
        grid,
        nothing_stands(len(heights)) if faces is None else faces,
        np.full((4, 4), roughness),
        LabelConfig() if config is None else config,
        0.1,
    )


def test_labels_by_height():
    heights = [0.0, 0.09, 0.11, -0.99, -1.01, np.nan]
    labels, margin = labels_of(heights, grid_of(*[3.0] * 6))
    assert [Label(value).name[0] for value in labels] == list('GGOGOO')
    assert labels.dtype == np.uint8
    np.testing.assert_allclose(margin[:5], [0.1, 0.01, -0.01, 0.01, -0.01], atol=1e-12)
    assert np.isnan(margin[5])


def test_points_that_are_not_finite_are_unknown():
    assert list(labels_of([np.nan, 0.0], grid_of(np.nan, 3.0))[0]) == [
        Label.UNKNOWN,
        Label.GROUND,
    ]


@pytest.mark.parametrize(
    ('other', 'is_ground'), [(1.0, False), (0.3, True), (2.5, True), (np.nan, True)]
)
def test_the_foot_of_an_obstacle_is_judged_more_strictly(other, is_ground):
    labels, _ = labels_of([0.08, other, 0.04, -0.15], grid_of(3.0, 3.5, 3.2, 3.9))
    assert (labels[0] == Label.GROUND) == is_ground
    assert list(labels[2:]) == [Label.GROUND, Label.GROUND]


def test_an_obstacle_speaks_only_for_its_own_bin_and_not_from_outside():
    heights, grid = np.array([0.15, 1.0, 1.0]), grid_of(3.0, 5.0, 1e3)
    found = stands_in_bin(heights, grid, LabelConfig())
    assert found.sum() == 1
    assert found[grid.segment[1], grid.bin[1]]


def test_the_band_follows_the_roughness_up_to_the_height_of_an_obstacle():
    heights = [0.3, 0.45, 0.51]
    grid = grid_of(3.0, 5.0, 7.0)
    assert list(labels_of(heights, grid)[0]) == [Label.OBSTACLE] * 3
    assert list(labels_of(heights, grid, roughness=0.08)[0]) == [
        Label.GROUND,
        Label.OBSTACLE,
        Label.OBSTACLE,
    ]
    assert list(labels_of(heights, grid, roughness=0.4)[0]) == [
        Label.GROUND,
        Label.GROUND,
        Label.OBSTACLE,
    ]


def test_of_a_face_only_the_foot_is_ground():
    # The surface climbs a step: its riser lies on it.
    z = np.array([0.05, 0.15, 0.4])
    grid = grid_of(5.0, 5.0, 5.0)
    step = faces_in(np.array([0, 0, 0]), np.array([0.0]), np.array([True]))
    assert list(labels_of(z * 0.0, grid, faces=step, z=z)[0]) == [
        Label.GROUND,
        Label.OBSTACLE,
        Label.OBSTACLE,
    ]
    assert list(labels_of(z * 0.0, grid, z=z)[0]) == [Label.GROUND] * 3


def test_roughness_is_the_root_mean_square_of_a_bin_and_its_neighbours():
    # Bins 0, 0, 2 of one segment; the last is no roughness but an obstacle.
    grid = grid_of(3.0, 3.5, 7.0, 3.0)
    found = local_roughness(np.array([0.1, -0.2, 0.3, 0.6]), grid, nothing_stands(4), 0.5)
    own = grid.segment[0]
    np.testing.assert_allclose(found[own, 0], np.sqrt((0.1**2 + 0.2**2) / 2))
    np.testing.assert_allclose(found[own, 1], np.sqrt((0.1**2 + 0.2**2 + 0.3**2) / 3))
    np.testing.assert_allclose(found[own, 3], 0.3)
    # The segments are a ring of four: the opposite one is not touched.
    assert found[(own + 1) % 4, 0] == found[(own - 1) % 4, 0] == found[own, 0]
    assert (found[(own + 2) % 4] == 0.0).all()


def test_points_of_faces_are_no_roughness():
    grid = grid_of(3.0, 3.0)
    one = faces_in(np.array([0, 1]), np.zeros(2), np.array([False, True]))
    found = local_roughness(np.array([0.1, 0.4]), grid, one, 0.5)
    np.testing.assert_allclose(found[grid.segment[0], grid.bin[0]], 0.1)


def test_probability_is_a_half_at_the_edge_and_follows_the_certainty():
    margin = np.array([0.0, 0.1, 0.1, -0.1, np.nan])
    std = np.array([0.1, 0.01, 0.3, 0.01, np.nan])
    found = ground_probability(margin, std, np.full(5, 0.02), 0.03)
    expected = scipy.stats.norm.cdf(margin / np.sqrt(std**2 + 0.02**2 + 0.03**2))
    np.testing.assert_allclose(found[:4], expected[:4], rtol=1e-6)
    assert found[0] == 0.5
    assert found[1] > found[2] > 0.5
    assert found[4] == 0.0


@settings(deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([np.float32, np.float64]), st.integers(1, 3))
def test_compiled_surface_and_labels_are_the_reference(seed, dtype, n_threads):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-12, 12, (300, 3)).astype(dtype)
    xyz[:, 2] *= 0.1
    # Posts, so that there are faces.
    xyz[100:200, :2] = np.repeat(xyz[100:120, :2], 5, axis=0) + rng.normal(0, 0.02, (100, 2))
    xyz[::20] = np.nan
    grid = build_polar_grid(xyz, GRID)
    surface = GroundSurface(
        KNOTS, rng.normal(0, 0.3, (4, 5)), rng.uniform(0, 1, (4, 5)), np.ones(0, dtype=bool)
    )
    surface.mean[seed % 4] = surface.std[seed % 4] = np.nan
    xyz = in_columns(xyz, Workspace())
    plain, config = NumpyBackend(), Config().replace(**{'surface.n_neighbours': 1})
    config = dataclasses.replace(config, grid=GRID)
    with sharing(n_threads) as backend:
        faces = backend.sort_points(xyz, config, Workspace()).find_faces()
        same = plain.sort_points(xyz, config, Workspace()).find_faces()
        np.testing.assert_array_equal(faces.is_face, same.is_face)
        np.testing.assert_array_equal(faces.is_footless, same.is_footless)
        assert faces.is_face.any()
        task = LabelTask(xyz, grid, faces, LabelConfig(), 0.1)
        found = backend.label_points(task, surface)
    expected = plain.label_points(task, surface)
    np.testing.assert_array_equal(found.label, expected.label)
    for name in ('height', 'margin', 'roughness'):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), atol=1e-12, err_msg=name
        )


@pytest.mark.parametrize('raised_by', [0.0, 0.5])
@pytest.mark.parametrize('is_disturbed', [False, True])
@pytest.mark.parametrize('n_threads', [1, 2])
def test_labels_are_those_asked_for_whatever_others_went_on_with(
    monkeypatch, raised_by, is_disturbed, n_threads
):
    """Other threads may label by another surface, or were called for something else since."""
    seen = []
    x, y = np.meshgrid(np.linspace(-20, 20, 120), np.linspace(-20, 20, 120))
    with sharing(n_threads) as backend:
        label, grow = backend.label_points, backend.grow_on_latent

        def remember(task, pseudo, to_label):
            seen.append((task, pseudo))
            return grow(task, pseudo, to_label)

        def label_other(task, surface):
            if is_disturbed:
                grow(*seen[-1])
            mean = surface.mean + raised_by if raised_by else surface.mean
            seen.append((task, dataclasses.replace(surface, mean=mean)))
            return label(*seen[-1])

        monkeypatch.setattr(backend, 'grow_on_latent', remember)
        monkeypatch.setattr(backend, 'label_points', label_other)
        config = Config().replace(**{'learning.mode': 'fixed'})
        segmenter = GroundSegmenter(config, backend=backend)
        # Each scan another one: memory that is used again may hold the results of the last.
        for k in range(3):
            z = 0.05 * np.sin(x + k) - 1.73
            found = segmenter.segment(np.stack([x, y, z], axis=-1).reshape(-1, 3))
    expected = NumpyBackend().label_points(*seen[-1])
    np.testing.assert_array_equal(found.label, expected.label)
    np.testing.assert_allclose(found.height, expected.height, atol=1e-12)
    assert np.nanmedian(found.height) == pytest.approx(-raised_by, abs=0.1)


@given(st.integers(0, 10_000), st.integers(0, 3))
def test_compiled_fusing_is_the_reference(seed, n_neighbours):
    rng = np.random.default_rng(seed)
    mean, std = rng.normal(0, 0.3, (9, 5)), rng.uniform(0, 0.5, (9, 5))
    std[:, 2] = 0.0
    # Some segments have no model at all, some up to a knot.
    n_known = rng.integers(0, 6, 9) * rng.integers(0, 2, 9)
    for m, n in enumerate(n_known):
        mean[m, n:] = std[m, n:] = np.nan
    found = np.empty((9, 5)), np.empty((9, 5))
    for start, stop in ((0, 4), (4, 9)):
        fuse_rows(start, stop, mean, std, n_known, KNOTS, n_neighbours, 0.05, -1.7, *found)
    expected = fuse_neighbours(mean, std, KNOTS, n_neighbours, 0.05)
    np.testing.assert_allclose(found[0], expected[0] - 1.7, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-9, atol=1e-12)
