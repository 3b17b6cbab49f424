import math

import numpy as np
import pytest
from conftest import BACKENDS, fewer, hilly_scan
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import lowest_of_cells, place_of

from gp_ground_seg import Config
from gp_ground_seg.core.frame import OUTSIDE
from gp_ground_seg.core.parameters.config import NARROWEST_BIN
from gp_ground_seg.core.pipeline.polar_grid import LARGEST_TABLE, bin_edges, grid_geometry

PLACE = st.floats(-120, 120)


def config_of(cell_size=0.5, **grid):
    values = {f'grid.{name}': value for name, value in grid.items()}
    return Config().replace(**values, **{'faces.cell_size': cell_size})


def assert_same_scan(found, expected):
    np.testing.assert_array_equal(found.grid.cell, expected.grid.cell)
    np.testing.assert_array_equal(found.grid.r, expected.grid.r)
    np.testing.assert_array_equal(found.extent, expected.extent)
    # Backends number the tiles in another order.
    tiles, others = found.tiles, expected.tiles
    inside = tiles.tile != OUTSIDE
    np.testing.assert_array_equal(inside, others.tile != OUTSIDE)
    np.testing.assert_array_equal(
        tiles.place[tiles.tile[inside]], others.place[others.tile[inside]]
    )
    order, other_order = np.argsort(tiles.place), np.argsort(others.place)
    np.testing.assert_array_equal(tiles.place[order], others.place[other_order])
    np.testing.assert_array_equal(tiles.extremes[order], others.extremes[other_order])
    for one in (tiles, others):
        at = np.full(len(one.at), OUTSIDE)
        at[one.place] = np.arange(len(one.place))
        np.testing.assert_array_equal(one.at, at)
    for name, column in found.candidates._asdict().items():
        other = getattr(expected.candidates, name)
        if name == 'tile':
            column, other = tiles.place[column], others.place[other]
        assert column.dtype == other.dtype
        rtol = 1e-12 if name == 'density' else 0.0
        np.testing.assert_allclose(column, other, rtol, err_msg=name)


def scans_of(xyz, config):
    """Scans of both backends, which are equal and have the candidates of the loops."""
    scans = [backend.build_grid(xyz, config) for backend in BACKENDS]
    expected = scans[0]._replace(candidates=lowest_of_cells(scans[0], config))
    for scan in scans:
        assert_same_scan(scan, expected)
    return scans


@settings(max_examples=fewer(40, 10))
@given(PLACE, PLACE, st.integers(4, 50), st.integers(4, 50), st.floats(1.0, 2.9))
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


def test_both_sides_of_the_negative_x_axis(backend):
    points = [[-10.0, 0.0, 0.0], [-10.0, -0.0, 0.0], [-10.0, 1e-9, 0.0], [-10.0, -1e-9, 0.0]]
    assert list(backend.build_grid(np.array(points), Config()).grid.segment) == [0, 0, 179, 0]


@pytest.mark.filterwarnings('ignore:overflow')
@settings(max_examples=fewer(30, 5))
@given(
    st.integers(0, 10_000), st.sampled_from([0, 1, 400]), st.sampled_from([np.float32, np.float64])
)
def test_cells_tiles_and_candidates_are_the_reference(compiled_code, seed, n, dtype):
    rng, xyz = np.random.default_rng(seed), hilly_scan(n, seed=seed)
    growth, n_bins = float(rng.uniform(1.0, 2.4)), int(rng.integers(4, 61))
    xyz[::7] = np.round(xyz[::7])  # equal heights, points on edges and axes
    xyz[::50, seed % 3] = np.nan
    # Infinite, or far away near the limit of single precision.
    xyz[::60, seed % 3] = [np.inf, -np.inf, 3e38, -3e38][seed % 4]
    config = config_of(n_bins=n_bins, bin_growth=growth, r_min=4.0, r_max=30.0, cell_size=0.7)
    scan = scans_of(xyz.astype(dtype), config)[seed % 2]
    finite = np.isfinite(xyz).all(axis=1)
    np.testing.assert_array_equal(np.isnan(scan.grid.r), ~finite)
    assert (scan.grid.bin[~finite] == OUTSIDE).all()
    np.testing.assert_array_equal(scan.xyz, xyz.astype(dtype))
    assert scan.xyz.flags.f_contiguous and not scan.xyz.flags.writeable
    candidates = scan.candidates
    for m, n_edges in enumerate(candidates.n_edges):
        own = candidates.bin[candidates.segment == m]
        assert (np.diff(own) > 0).all()
        assert n_edges == (own[-1] + 2 if len(own) else 0)


def test_bins_of_a_low_sensor_are_nearer_and_leave_the_others_where_they_are():
    """At most twice as many, however narrow they are."""
    usual, near = (bin_edges(Config().replace(**{'grid.r_min': r}).grid) for r in (2.0, 0.6))
    np.testing.assert_array_equal(near[-len(usual) :], usual)
    widths = np.diff(near[: len(near) - len(usual) + 1]) / (usual[1] - usual[0])
    assert near[0] == 0.6 and 0.8 < widths.min() <= widths.max() <= 1.0
    narrow = {'grid.n_bins': 1024, 'grid.r_min': 0.0, 'grid.bin_growth': 1.6}
    assert len(bin_edges(Config().replace(**narrow).grid)) <= 2049


def test_the_narrowest_bins_that_are_accepted_do_not_fill_the_memory():
    config = config_of(
        2.0, n_bins=1024, bin_growth=1.892, r_max=500.0, n_segments=fewer(2048, 200)
    )
    for dtype in (np.float32, np.float64):
        geometry = grid_geometry(config.grid, 2.0, np.dtype(dtype))
        assert np.diff(geometry.edges).min() < 1.05 * NARROWEST_BIN
        assert len(geometry.ranges.bins) <= LARGEST_TABLE + 2
        xyz = hilly_scan(4000, seed=3).astype(dtype)
        scans_of(xyz, config)
