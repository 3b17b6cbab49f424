import dataclasses
import math

import numpy as np
import pytest
from conftest import hilly_scan, sharing
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import as_strided

from gp_ground_seg.compiled.backend import CompiledBackend
from gp_ground_seg.compiled.rulers import grid_rulers
from gp_ground_seg.compiled.workspace import Workspace
from gp_ground_seg.frame import OUTSIDE
from gp_ground_seg.parameters.config import Config, FacesConfig, GridConfig
from gp_ground_seg.pipeline.points import flat_rows, in_columns, single_precision, take_points
from gp_ground_seg.pipeline.polar_grid import (
    bin_edges,
    build_polar_grid,
    ground_candidates,
    pseudo_angle,
    reduce_cells,
)
from gp_ground_seg.pipeline.tiles import build_tiles

MIN_EXTENT = Config().lines.min_density_extent


def build(points, grid=None):
    xyz = np.asarray(points)
    return build_polar_grid(xyz, grid or GridConfig())


def taken(points):
    return in_columns(points, Workspace())


def lowest_points(grid, z, min_extent):
    nowhere = np.zeros(len(z), dtype=np.int32)
    return ground_candidates(reduce_cells(grid, z, nowhere), grid.edges, min_extent)


def sort(xyz, grid=None, n_threads=1, cell_size=0.5):
    """Sort points with compiled code, in a backend of its own."""
    config = dataclasses.replace(
        Config(), grid=grid or GridConfig(), faces=FacesConfig(cell_size=cell_size)
    )
    backend = CompiledBackend(n_threads)
    found = backend.sort_points(xyz, config, Workspace())
    found.find_faces()
    backend.close()
    return found


def assert_same_candidates(found, expected):
    for name, column in vars(found).items():
        np.testing.assert_array_equal(column, getattr(expected, name), err_msg=name)


def slow_bin(r, grid):
    """Bin of a range, said plainly."""
    edges = bin_edges(grid)
    if r >= edges[-1]:
        return OUTSIDE
    return next(n for n in range(grid.n_bins) if r < edges[n + 1])


@given(
    st.floats(-120, 120),
    st.floats(-120, 120),
    st.integers(4, 50),
    st.integers(4, 50),
    st.floats(1.0, 3.0),
)
def test_cell_of_a_point_is_the_one_said_plainly(x, y, n_segments, n_bins, growth):
    grid = GridConfig(n_segments=n_segments, n_bins=n_bins, bin_growth=growth)
    built = build([[x, y, 0.0]], grid)
    r = math.hypot(x, y)
    assert built.r[0] == pytest.approx(r, rel=1e-14, abs=1e-150)
    assert built.bin[0] == slow_bin(built.r[0], grid)
    # The origin counts as lying on +x, also where its x is -0.
    turn = (math.atan2(y, x if r > 0.0 else 1.0) / (2 * math.pi) + 0.5) * n_segments
    if built.bin[0] == OUTSIDE:
        assert built.segment[0] == 0
    elif abs(turn - round(turn)) < 1e-9:
        # On an edge, rounding decides.
        assert built.segment[0] in {round(turn) % n_segments, (round(turn) - 1) % n_segments}
    else:
        assert built.segment[0] == int(turn)


def test_edges_span_the_range_and_grow():
    edges = bin_edges(GridConfig(n_bins=10, r_min=1.0, r_max=101.0, bin_growth=2.0))
    assert edges[0] == 1.0
    assert edges[-1] == 101.0
    np.testing.assert_allclose(np.diff(edges), 1.0 + 2.0 * np.arange(10))


def test_points_that_are_not_finite_are_outside_with_no_range():
    built = build([[np.nan, 1.0, 0.0], [np.inf, 1.0, 0.0], [5.0, 0.0, np.nan], [5.0, 0.0, 0.0]])
    assert list(built.bin[:3]) == [OUTSIDE] * 3
    assert np.isnan(built.r[:3]).all()
    assert built.bin[3] != OUTSIDE


def test_both_sides_of_the_negative_x_axis():
    built = build([[-10.0, 0.0, 0.0], [-10.0, -0.0, 0.0], [-10.0, 1e-9, 0.0], [-10.0, -1e-9, 0.0]])
    assert list(built.segment) == [0, 0, 179, 0]


def test_lowest_point_of_every_bin():
    xyz = hilly_scan(3000, seed=1)
    grid = build(xyz)
    candidates = lowest_points(grid, xyz[:, 2], 0.05)
    best = {}
    for segment, index, r, z in zip(grid.segment, grid.bin, grid.r, xyz[:, 2], strict=True):
        cell = (segment, index)
        best[cell] = min(best.get(cell, (np.inf, np.inf)), (z, r))
    expected = [(*cell, *best[cell]) for cell in sorted(best)]
    found = zip(candidates.segment, candidates.bin, candidates.z, candidates.r, strict=True)
    assert list(found) == expected
    assert candidates.offsets[-1] == len(candidates.r)


def test_equal_heights_are_settled_by_range_not_by_order():
    points = np.array([[5.02, 0.0, -1.7], [5.01, 0.0, -1.7], [5.03, 0.0, -1.7]])
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        shuffled = points[order]
        candidates = lowest_points(build(shuffled), shuffled[:, 2], 0.05)
        assert list(candidates.r) == [5.01]


def test_candidates_of_a_segment_come_in_order_of_range():
    xyz = hilly_scan(5000, seed=2)
    candidates = lowest_points(build(xyz), xyz[:, 2], 0.05)
    for first, last in zip(candidates.offsets[:-1], candidates.offsets[1:], strict=True):
        assert (np.diff(candidates.r[first:last]) > 0).all()


def test_empty_grid():
    candidates = lowest_points(build(np.empty((0, 3))), np.empty(0), 0.05)
    assert len(candidates.r) == 0
    assert list(candidates.offsets) == [0] * (Config().grid.n_segments + 1)


@pytest.mark.parametrize('segments_turned', [1, 7, 90])
def test_turning_the_scan_by_segments_turns_the_segments(segments_turned):
    xyz = hilly_scan(2000, seed=3)
    angle = segments_turned * 2 * np.pi / 180
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = xyz.copy()
    turned[:, :2] = xyz[:, :2] @ rotation.T
    np.testing.assert_array_equal(
        build(turned).segment, (build(xyz).segment + segments_turned) % 180
    )


@pytest.mark.parametrize('n_slices', [1, 2, 7])
def test_vertical_density_is_the_mean_over_the_slices_however_many(n_slices):
    """The paper's definition, slice by slice."""
    xyz = hilly_scan(3000, seed=4)
    grid = build(xyz)
    candidates = lowest_points(grid, xyz[:, 2], 0.05)
    widths = np.diff(grid.edges)
    for m, n, density in list(
        zip(candidates.segment, candidates.bin, candidates.density, strict=True)
    )[::40]:
        z = xyz[(grid.segment == m) & (grid.bin == n), 2]
        top = max(z.max(), z.min() + 0.05)
        counts, _ = np.histogram(z, bins=n_slices, range=(z.min(), top))
        area = widths[n] * (top - z.min()) / n_slices
        assert density == pytest.approx(np.mean(counts / area))


@settings(deadline=None)
@given(
    st.integers(0, 10_000),
    st.floats(1.0, 3.0),
    st.integers(4, 60),
    st.sampled_from([np.float32, np.float64]),
)
def test_compiled_passes_are_the_reference(seed, growth, n_bins, dtype):
    xyz = hilly_scan(400, seed=seed)
    xyz[::7] = np.round(xyz[::7])  # equal heights, points on edges and axes
    xyz[::50, seed % 3] = np.nan
    xyz[::60, seed % 3] = extreme(seed)
    xyz = taken(xyz.astype(dtype))
    grid = GridConfig(n_bins=n_bins, bin_growth=growth, r_min=4.0, r_max=30.0)
    expected = build(xyz, grid)
    with np.errstate(over='ignore'):  # infinitely far is outside, where numba is missing too
        found = sort(xyz, grid, 1 + seed % 3, cell_size=0.7)
    np.testing.assert_array_equal(found.grid.cell, expected.cell)
    np.testing.assert_array_equal(found.grid.r, expected.r)
    expected_tiles = build_tiles(xyz, expected, 0.7)
    expected_cells = reduce_cells(expected, xyz[:, 2], expected_tiles.tile)
    assert_same_candidates(
        found.candidates, ground_candidates(expected_cells, expected.edges, MIN_EXTENT)
    )
    assert_same_tiles(found.find_faces().tiles, expected_tiles)


def test_the_narrowest_bins_that_are_accepted_do_not_fill_the_memory():
    grid = GridConfig(n_bins=1024, bin_growth=4.0, n_segments=2048)
    edges, ranges, _ = grid_rulers(grid, np.dtype(np.float64))
    assert len(ranges.bins) < 40_000
    assert ranges.is_coarse
    xyz = taken(hilly_scan(4000, seed=3))
    np.testing.assert_array_equal(sort(xyz, grid).grid.cell, build(xyz, grid).cell)
    assert len(edges) == 1025


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize('step', [3, 4, 7])
def test_rows_are_sorted_as_columns_are_and_left_as_they_were(step, dtype):
    room = np.zeros((9010, step), dtype=dtype)
    rows = room[5:-5]
    rows[:, :3] = hilly_scan(9000, seed=step)
    before = rows.copy()
    xyz = take_points(rows)
    assert flat_rows(xyz)[1] == step
    assert np.shares_memory(xyz, rows)
    found, expected = sort(xyz, n_threads=2), sort(taken(xyz))
    np.testing.assert_array_equal(found.xyz, rows[:, :3])
    assert found.xyz.flags.f_contiguous
    np.testing.assert_array_equal(found.grid.cell, expected.grid.cell)
    assert_same_candidates(found.candidates, expected.candidates)
    np.testing.assert_array_equal(rows, before)


@pytest.mark.parametrize(
    'rows',
    [
        np.arange(28.0).reshape(4, 7)[:, 2:5],
        np.arange(28.0).reshape(4, 7)[::2, 4:],
        np.arange(60.0).reshape(3, 4, 5)[1, :, :3],
        np.frombuffer(np.arange(20, dtype=np.float32).tobytes(), np.float32).reshape(5, 4)[1:, 1:],
        as_strided(np.arange(30.0), (4, 3), (40, 8)),
        as_strided(
            np.arange(30.0, dtype=np.float32).view(np.uint8)[4:].view(np.float32), (4, 3), (16, 4)
        ),
    ],
)
def test_flat_rows_are_the_same_memory(rows):
    flat, step = flat_rows(rows)
    assert np.shares_memory(flat, rows)
    np.testing.assert_array_equal(
        as_strided(flat, rows.shape, (step * flat.itemsize, flat.itemsize)), rows
    )
    assert len(flat) == (len(rows) - 1) * step + 3
    assert not flat.flags.writeable


@pytest.mark.parametrize(
    'rows',
    [
        np.zeros((5, 3))[::-1],
        np.zeros((5, 4))[:, ::-1][:, :3],
        np.zeros((3, 5)).T,
        np.broadcast_to(np.zeros(3), (5, 3)),
        np.zeros((5, 6))[:, ::2],
        np.zeros((0, 3)),
    ],
)
def test_what_does_not_lie_row_behind_row_is_no_flat_memory(rows):
    assert flat_rows(rows)[1] == 0
    assert len(sort(rows).xyz) == len(rows)


def test_single_precision_keeps_finite_what_is():
    xyz = np.array([[1.0, 1e300, -1e300], [np.inf, -np.inf, np.nan], [0.1, 2.0, 3.0]])
    single = single_precision(xyz)
    assert single.dtype == np.float32
    np.testing.assert_array_equal(np.isfinite(single), np.isfinite(xyz))
    assert single[0, 1] > 3e38
    assert single[0, 2] < -3e38
    assert np.isposinf(single[1, 0])
    np.testing.assert_array_equal(single[2], np.float32([0.1, 2.0, 3.0]))
    assert single_precision(single) is single


def assert_same_tiles(found, expected):
    np.testing.assert_array_equal(found.tile, expected.tile)
    np.testing.assert_array_equal(found.extremes, expected.extremes)
    np.testing.assert_array_equal(np.sort(found.touched), np.sort(expected.touched))


def extreme(seed):
    """Infinite, or far away on the edge of single precision."""
    return [np.inf, -np.inf, 3e38, -3e38][seed % 4]


@pytest.mark.parametrize('n_threads', [2, 3, 5])
def test_shares_of_the_points_are_merged(n_threads):
    backend, workspace, config = CompiledBackend(n_threads), Workspace(), Config()
    # Small clouds are not shared out, and leave other tables behind.
    for n_points in (9000, 300, 50_000, 9000):
        xyz = hilly_scan(n_points, seed=5)
        xyz[::3] = np.round(xyz[::3])  # equal heights, in all shares
        found, expected = backend.sort_points(taken(xyz), config, workspace), sort(taken(xyz))
        np.testing.assert_array_equal(found.grid.cell, expected.grid.cell)
        assert_same_candidates(found.candidates, expected.candidates)
        faces, same = found.find_faces(), expected.find_faces()
        assert_same_tiles(faces.tiles, same.tiles)
        np.testing.assert_array_equal(faces.is_face, same.is_face)
        np.testing.assert_array_equal(faces.is_footless, same.is_footless)
        assert faces.is_face.any() or n_points == 300
    backend.close()


@pytest.mark.parametrize('n_threads', [1, 2, 3])
def test_what_a_scan_leaves_in_the_tables_does_not_show_in_the_next(n_threads):
    other = Config().replace(**{'faces.cell_size': 0.7})
    workspace = Workspace()
    with sharing(n_threads) as backend:
        for seed, config, dtype, seeks_faces, are_wanted in (
            (1, Config(), np.float64, True, True),
            (2, Config(), np.float64, True, True),
            (3, Config(), np.float64, True, False),
            (4, Config(), np.float64, True, True),
            (5, other, np.float64, True, True),
            (6, Config(), np.float64, True, True),
            (7, Config(), np.float64, False, False),
            (8, Config(), np.float64, True, True),
            (9, Config(), np.float32, True, True),
            (10, Config(), np.float64, True, True),
        ):
            xyz = taken(hilly_scan(5000, seed=seed).astype(dtype))
            found = backend.sort_points(xyz, config, workspace, seeks_faces)
            if not are_wanted:
                found.drop_faces()
                with pytest.raises(RuntimeError, match='dropped'):
                    found.find_faces()
                continue
            fresh = CompiledBackend(1).sort_points(xyz, config, Workspace())
            faces, same = found.find_faces(), fresh.find_faces()
            assert_same_candidates(found.candidates, fresh.candidates)
            assert_same_tiles(faces.tiles, same.tiles)
            np.testing.assert_array_equal(faces.is_face, same.is_face)
            np.testing.assert_array_equal(faces.is_footless, same.is_footless)


@pytest.mark.parametrize('n_threads', [1, 2, 3])
def test_other_points_may_be_sorted_while_faces_are_looked_for(n_threads):
    backend, config = CompiledBackend(n_threads), Config()
    for _ in range(5):
        found = backend.sort_points(taken(hilly_scan(50_000, seed=5)), config, Workspace())
        for n_points in (300, 0):
            other = taken(hilly_scan(n_points, seed=3))
            sample = backend.sort_points(other, config, Workspace(), seeks_faces=False)
            assert_same_candidates(sample.candidates, sort(other).candidates)
        faces, same = found.find_faces(), sort(found.xyz).find_faces()
        assert_same_tiles(faces.tiles, same.tiles)
        np.testing.assert_array_equal(faces.is_face, same.is_face)
    backend.close()


@given(st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi), st.floats(0.01, 1e3))
def test_pseudo_angle_grows_with_the_angle(one, other, r):
    x, y = r * np.cos([one, other]), r * np.sin([one, other])
    first, second = pseudo_angle(x, y)
    assert 0.0 <= first <= 4.0
    if one + 1e-9 < other:
        assert first < second
