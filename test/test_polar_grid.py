import math

import numpy as np
import pytest
from conftest import fewer, hilly_scan, sharing
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import Reference, place_of

from gp_ground_seg import Config
from gp_ground_seg.backend import NumpyBackend
from gp_ground_seg.compiled.backend import NumbaBackend
from gp_ground_seg.compiled.polar_grid import BinLookup, grid_geometry
from gp_ground_seg.frame import OUTSIDE
from gp_ground_seg.parameters.config import GridConfig
from gp_ground_seg.pipeline.polar_grid import azimuth_key, bin_edges


def config_of(cell_size=0.5, **grid):
    values = {f'grid.{name}': value for name, value in grid.items()}
    return Config().replace(**values, **{'faces.cell_size': cell_size, 'surface.n_neighbours': 0})


def assert_same_scan(found, expected):
    np.testing.assert_array_equal(found.grid.cell, expected.grid.cell)
    np.testing.assert_array_equal(found.grid.r, expected.grid.r)
    np.testing.assert_array_equal(found.tiles.tile, expected.tiles.tile)
    np.testing.assert_array_equal(found.tiles.extremes, expected.tiles.extremes)
    np.testing.assert_array_equal(np.sort(found.tiles.occupied), np.sort(expected.tiles.occupied))
    for name, column in found.candidates._asdict().items():
        other = getattr(expected.candidates, name)
        assert column.dtype == other.dtype
        np.testing.assert_array_equal(column, other, err_msg=name)


@settings(max_examples=fewer(100, 10))
@given(
    st.floats(-120, 120),
    st.floats(-120, 120),
    st.integers(4, 50),
    st.integers(4, 50),
    st.floats(1.0, 3.0),
)
def test_cell_of_a_point(backend, x, y, n_segments, n_bins, growth):
    config = config_of(n_segments=n_segments, n_bins=n_bins, bin_growth=growth)
    grid = backend.build_grid(np.array([[x, y, 0.0]]), config).grid
    assert grid.r[0] == pytest.approx(math.hypot(x, y), rel=1e-14, abs=1e-150)
    expected_bin, turn = place_of(x, y, config.grid)
    if expected_bin is None:
        assert (grid.bin[0], grid.segment[0]) == (OUTSIDE, 0)
        return
    assert grid.bin[0] == expected_bin
    if abs(turn - round(turn)) < 1e-9:
        # On an edge, rounding decides.
        assert grid.segment[0] in {round(turn) % n_segments, (round(turn) - 1) % n_segments}
    else:
        assert grid.segment[0] == int(turn)


def test_edges_span_the_range_and_grow():
    edges = bin_edges(GridConfig(n_bins=10, r_min=1.0, r_max=101.0, bin_growth=2.0))
    assert (edges[0], edges[-1]) == (1.0, 101.0)
    np.testing.assert_allclose(np.diff(edges), 1.0 + 2.0 * np.arange(10))


@given(st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi), st.floats(0.01, 1e3))
def test_azimuth_key_grows_with_the_angle(one, other, r):
    x, y = r * np.cos([one, other]), r * np.sin([one, other])
    first, second = azimuth_key(x, y)
    assert 0.0 <= first <= 4.0
    if one + 1e-9 < other:
        assert first < second


def test_points_that_are_not_finite_have_no_cell_and_no_range(backend):
    points = [[np.nan, 1.0, 0.0], [np.inf, 1.0, 0.0], [5.0, 0.0, np.nan], [5.0, 0.0, 0.0]]
    grid = backend.build_grid(np.array(points), Config()).grid
    assert list(grid.bin[:3]) == [OUTSIDE] * 3
    assert np.isnan(grid.r[:3]).all()
    assert grid.bin[3] != OUTSIDE


def test_both_sides_of_the_negative_x_axis(backend):
    points = [[-10.0, 0.0, 0.0], [-10.0, -0.0, 0.0], [-10.0, 1e-9, 0.0], [-10.0, -1e-9, 0.0]]
    assert list(backend.build_grid(np.array(points), Config()).grid.segment) == [0, 0, 179, 0]


@pytest.mark.filterwarnings('ignore:overflow')
@settings(max_examples=fewer(100, 5))
@given(
    st.integers(0, 10_000),
    st.floats(1.0, 3.0),
    st.integers(4, 60),
    st.sampled_from([np.float32, np.float64]),
)
def test_cells_tiles_and_candidates_are_the_reference(backend, seed, growth, n_bins, dtype):
    xyz = hilly_scan(400, seed=seed)
    xyz[::7] = np.round(xyz[::7])  # equal heights, points on edges and axes
    xyz[::50, seed % 3] = np.nan
    # Infinite, or far away near the limit of single precision.
    xyz[::60, seed % 3] = [np.inf, -np.inf, 3e38, -3e38][seed % 4]
    config = config_of(n_bins=n_bins, bin_growth=growth, r_min=4.0, r_max=30.0, cell_size=0.7)
    scan = backend.build_grid(xyz.astype(dtype), config)
    assert_same_scan(scan, Reference().build_grid(xyz.astype(dtype), config))
    np.testing.assert_array_equal(scan.xyz, xyz.astype(dtype))
    assert scan.xyz.flags.f_contiguous and not scan.xyz.flags.writeable
    candidates = scan.candidates
    for m, n_edges in enumerate(candidates.n_edges):
        own = candidates.bin[candidates.segment == m]
        assert (np.diff(own) > 0).all()
        assert n_edges == (own[-1] + 2 if len(own) else 0)


def test_equal_heights_are_resolved_by_range_not_by_order(backend):
    points = np.array([[5.02, 0.0, -1.7], [5.01, 0.0, -1.7], [5.03, 0.0, -1.7]])
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        assert list(backend.build_grid(points[order], Config()).candidates.r) == [5.01]


def test_no_points(backend):
    candidates = backend.build_grid(np.empty((0, 3)), Config()).candidates
    assert len(candidates.r) == 0
    assert list(candidates.offsets) == [0] * (Config().grid.n_segments + 1)


@pytest.mark.parametrize('n_turned', [1, 7, 90])
def test_rotating_the_scan_by_segments_shifts_the_segments(backend, n_turned):
    xyz = hilly_scan(2000, seed=3)
    c, s = np.cos(n_turned * 2 * np.pi / 180), np.sin(n_turned * 2 * np.pi / 180)
    turned = xyz @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    # A copy: the numba backend sorts the next scan into the same arrays.
    before = backend.build_grid(xyz, Config()).grid.segment.copy()
    after = backend.build_grid(turned, Config()).grid.segment
    np.testing.assert_array_equal(after, (before + n_turned) % 180)


@pytest.mark.parametrize('n_slices', [1, 2, 7])
def test_vertical_density_is_the_mean_over_the_slices_of_a_bin(backend, n_slices):
    """Section II of the paper; the number of slices does not matter."""
    xyz = hilly_scan(3000, seed=4)
    scan = backend.build_grid(xyz, Config())
    grid, candidates = scan.grid, scan.candidates
    for c in range(0, len(candidates.r), 40):
        m, n = candidates.segment[c], candidates.bin[c]
        z = xyz[(grid.segment == m) & (grid.bin == n), 2]
        top = max(z.max(), z.min() + Config().lines.min_density_extent)
        counts, _ = np.histogram(z, bins=n_slices, range=(z.min(), top))
        area = np.diff(grid.edges)[n] * (top - z.min()) / n_slices
        assert candidates.density[c] == pytest.approx(np.mean(counts / area))


def test_the_narrowest_bins_that_are_accepted_do_not_fill_the_memory():
    config = config_of(n_bins=1024, bin_growth=4.0, n_segments=fewer(2048, 200))
    geometry = grid_geometry(config.grid, 0.5, np.dtype(np.float64))
    assert len(geometry.ranges.bins) < 40_000
    assert geometry.ranges.is_coarse
    xyz = hilly_scan(4000, seed=3)
    found = NumbaBackend(1).build_grid(xyz, config)
    assert_same_scan(found, NumpyBackend().build_grid(xyz, config))


@given(st.integers(0, 10_000), st.integers(1, 9), st.sampled_from([np.float32, np.float64]))
def test_bin_lookup_gives_the_bin_or_the_one_before(seed, fineness, dtype):
    rng = np.random.default_rng(seed)
    edges = np.cumsum(rng.uniform(0.1, 2.0, 30))
    lookup = BinLookup.of(edges, fineness, np.dtype(dtype))
    inside = rng.uniform(edges[0], edges[-1], 200).astype(dtype)
    inside = inside[(inside >= edges[0]) & (inside < edges[-1])]
    entry = ((inside - lookup.edges[0]) * dtype(lookup.scale)).astype(np.int32)
    found = lookup.bins[entry] + (inside >= lookup.ends[entry])
    expected = np.searchsorted(edges, inside.astype(np.float64), side='right') - 1
    assert (found <= expected).all()
    assert lookup.is_coarse or (found == expected).all()


@pytest.mark.parametrize('n_threads', [1, 2, 3])
def test_nothing_of_one_scan_shows_in_the_next(n_threads):
    n = fewer(5000, 500)
    other = Config().replace(**{'faces.cell_size': 0.7})
    scans = [
        (n, Config(), np.float64), (n, Config(), np.float64), (300, Config(), np.float64),
        (n, other, np.float64), (n, Config(), np.float64), (n, Config(), np.float32),
        (0, Config(), np.float32), (2 * n, Config(), np.float64), (n, Config(), np.float64),
    ]  # fmt: skip
    n_faces = 0
    with sharing(n_threads) as backend:
        for seed, (n_points, config, dtype) in enumerate(scans):
            xyz = hilly_scan(n_points, seed=seed).astype(dtype)
            xyz[::3] = np.round(xyz[::3])  # equal heights, in all parts
            found, fresh = backend.build_grid(xyz, config), NumpyBackend()
            expected = fresh.build_grid(xyz, config)
            assert_same_scan(found, expected)
            faces, same = backend.find_faces(found, config), fresh.find_faces(expected, config)
            np.testing.assert_array_equal(faces.is_face, same.is_face)
            np.testing.assert_array_equal(faces.has_occluded_base, same.has_occluded_base)
            n_faces += faces.is_face.sum()
    assert n_faces > 0
