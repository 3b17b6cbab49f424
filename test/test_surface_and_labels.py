import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.config import GridConfig, LabelConfig
from gp_ground_seg.gp.compiled_backend import CompiledBackend
from gp_ground_seg.labelling import label_points, stands_in_bin
from gp_ground_seg.labels import Label
from gp_ground_seg.polar_grid import build_polar_grid
from gp_ground_seg.surface import GroundSurface, fuse_neighbours

GRID = GridConfig(n_segments=4, n_bins=4, r_min=2.0, r_max=10.0, bin_growth=1.0)
KNOTS = np.array([2.0, 4.0, 6.0, 8.0, 10.0])


def grid_of(*ranges, angle=0.1):
    xyz = np.array([[r * np.cos(angle), r * np.sin(angle), 0.0] for r in ranges])
    return build_polar_grid(xyz, np.isfinite(xyz).all(axis=1), GRID)


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


def test_labels_by_height():
    heights = np.array([0.0, 0.19, 0.21, -0.19, -0.21, np.nan])
    grid = grid_of(3.0, 3.0, 3.0, 3.0, 3.0, 3.0)
    labels = label_points(heights, grid, surface_of([0.0] * 5), LabelConfig())
    assert [Label(value).name[0] for value in labels] == list('GGOGOO')
    assert labels.dtype == np.uint8


def test_points_that_are_not_finite_are_unknown():
    labels = label_points(
        np.array([np.nan, 0.0]), grid_of(np.nan, 3.0), surface_of([0.0] * 5), LabelConfig()
    )
    assert list(labels) == [Label.UNKNOWN, Label.GROUND]


@pytest.mark.parametrize(
    ('other', 'is_ground'), [(1.0, False), (0.3, True), (2.5, True), (np.nan, True)]
)
def test_the_foot_of_an_obstacle_is_judged_more_strictly(other, is_ground):
    heights = np.array([0.15, other, 0.05, -0.15])
    grid = grid_of(3.0, 3.5, 3.2, 3.9)
    labels = label_points(heights, grid, surface_of([0.0] * 5), LabelConfig())
    assert (labels[0] == Label.GROUND) == is_ground
    assert list(labels[2:]) == [Label.GROUND, Label.GROUND]


def test_an_obstacle_speaks_only_for_its_own_bin_and_not_from_outside():
    heights = np.array([0.15, 1.0, 1.0])
    found = stands_in_bin(heights, grid_of(3.0, 5.0, 1e3), LabelConfig())
    assert list(found) == [False, True, False]


def test_tolerance_widens_where_the_surface_rises():
    heights = np.array([0.5, -0.5])
    grid = grid_of(5.0, 5.0)
    level, steep = surface_of([0.0] * 5), surface_of([0.0, 0.0, 0.4, 0.4, 0.4])
    assert list(label_points(heights, grid, level, LabelConfig())) == [Label.OBSTACLE] * 2
    config = LabelConfig(obstacle_min_height=1.0)
    assert list(label_points(heights, grid, steep, config)) == [Label.GROUND] * 2


@settings(deadline=None)
@given(st.integers(0, 10_000))
def test_compiled_surface_and_labels_are_the_reference(seed):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-12, 12, (200, 3))
    xyz[::20] = np.nan
    grid = build_polar_grid(xyz, np.isfinite(xyz).all(axis=1), GRID)
    surface = GroundSurface(
        KNOTS, rng.normal(0, 0.3, (4, 5)), rng.uniform(0, 1, (4, 5)), np.ones(0, dtype=bool)
    )
    surface.mean[seed % 4] = surface.std[seed % 4] = np.nan
    backend = CompiledBackend(1)
    for found, expected in zip(
        backend.surface_under_points(surface, grid), surface.at(grid), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    height = rng.normal(0, 0.5, 200)
    height[::9] = np.nan
    np.testing.assert_array_equal(
        backend.label_points(height, grid, surface, LabelConfig()),
        label_points(height, grid, surface, LabelConfig()),
    )
