"""Compiled twin of `gp_ground_seg.core.pipeline.vertical_faces`.

Of the tiles to examine, the returns are summed, the lowest and those above apart; the sums
tell which tiles show no ground. Coordinates are rounded so that the sums are exact in any order.
"""

import math

import numpy as np

from gp_ground_seg.core.compiled.roughness import level_at, levels_about, levels_of
from gp_ground_seg.core.frame import OUTSIDE, CellArray, Faces, FloatArray, PointArray, Scan, Tiles
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import FacesConfig, LabelConfig
from gp_ground_seg.core.pipeline import vertical_faces as plain
from gp_ground_seg.core.pipeline.roughness import UNKNOWN_LEVEL
from gp_ground_seg.core.pipeline.terrain import mark_beyond_edges


@jit(entry=True)
def find_faces(
    scan: Scan, height: float, config: FacesConfig, label: LabelConfig, faces: Faces
) -> None:
    """Find the tiles of a scan, of points (3, N), that show no ground, into empty `faces`."""
    tiles, candidates, n_bins = scan.tiles, scan.candidates, len(scan.grid.edges) - 1
    shows_ground, tolerance = np.zeros(len(tiles.place), np.bool_), label.ground_tolerance
    for m in range(len(candidates.offsets) - 1):
        for c in range(candidates.offsets[m], candidates.offsets[m + 1]):
            cell, t = m * n_bins + candidates.bin[c], candidates.tile[c]
            is_foot = candidates.z[c] - np.float64(tiles.extremes[t, 0]) <= tolerance
            shows_ground[t] |= is_foot and plain.is_flat(scan.extent[cell], tolerance)
    tall, number = _select_tall(tiles, height, label)
    sums = _sum_returns(scan.xyz, tiles, tall, config.cell_size, height, label, number)
    whole = np.empty((len(tall), plain.SUMS))
    for k in range(len(tall)):
        t, low, high = np.uintp(tall[k]), sums[2 * k], sums[2 * k + 1]
        for i in range(plain.SUMS):
            whole[k, i] = low[i] + high[i]
        extent = np.float64(tiles.extremes[t, 1]) - np.float64(tiles.extremes[t, 0])
        if extent > plain.face_height(label):
            faces.is_face[t] = is_face = plain.is_vertical(whole[k], config)
            faces.is_steep[t] = plain.is_steep(high)
            is_occluded = (
                is_face and not shows_ground[t] and plain.is_base_occluded(low, high, config)
            )
            faces.has_occluded_base[t] = is_occluded
    _mark_scattered(tiles, tall, whole, height, label, faces)
    mark_beyond_edges(candidates, height, plain.face_height(label), faces)


@jit()
def _mark_scattered(
    tiles: Tiles,
    tall: CellArray,
    sums: FloatArray,
    height: float,
    label: LabelConfig,
    faces: Faces,
) -> None:
    """Mark raised tiles about which many scatter, by the sums (K, SUMS) of those to examine.

    The first rows of `sums` become those of the raised tiles.
    """
    n, n_own, face, n_sides = 0, 0, plain.face_height(label), int(math.sqrt(len(tiles.at)))
    raised, own, square = np.empty_like(tall), np.empty(len(tall)), np.empty(len(tall))
    for k in range(len(tall)):
        t = np.uintp(tall[k])
        low, high = np.float64(tiles.extremes[t, 0]), np.float64(tiles.extremes[t, 1])
        if faces.is_face[t]:
            continue
        scatter = plain.scatter_square(sums[k])
        if scatter > plain.ONE_RING and plain.is_of_own_level(high - low, low + height, label):
            own[n_own] = scatter
            n_own += 1
        if low + height > 0.5 * face:
            raised[n], square[n] = t, scatter
            for i in range(np.uintp(plain.SUMS)):
                sums[n, i] = sums[k, i]
            n += 1
    _, counts = levels_of(own[:n_own], plain.SQUARE_SCATTERS)
    limit = plain.smooth_up_to(plain.SCATTER[level_at(counts, counts.sum(), plain.OWN_SHARE)])
    place, level = tiles.place[raised[:n]], np.empty(n, np.int32)
    block, places, blocks, small = _merged(place, n_sides, sums[:n])
    wide_block, _, _, large = _merged(places, (n_sides + 1) // 2, blocks)
    for k in range(n):
        b = np.uintp(block[k])
        level[k] = plain.vote_on_scatter(
            square[k], small[b], large[np.uintp(wide_block[b])], limit
        )
    about = levels_about(place, level, n_sides, plain.SCATTERED, 0)
    for k in range(n):
        over = np.float64(tiles.extremes[raised[k], 0]) + height
        if level[k] != UNKNOWN_LEVEL and about[k] > 0 and over > face:
            faces.is_face[raised[k]] = faces.has_occluded_base[raised[k]] = True


@jit()
def _merged(
    place: CellArray, n_sides: int, sums: FloatArray
) -> tuple[CellArray, CellArray, FloatArray, FloatArray]:
    """Add up `sums` (K, SUMS) of places in blocks of two by two.

    Return the block of each; and of the blocks the place, where a row has half as many, the sums,
    and `slope_square`.
    """
    width, n = (n_sides + 1) // 2, 0
    number, block, places = np.zeros(width * width, np.int32), np.empty_like(place), place.copy()
    blocks, square = np.zeros_like(sums), np.empty(len(sums))
    for k in range(len(place)):
        # A division of whole numbers takes longer.
        column = np.int32((place[k] + 0.5) / n_sides)
        at = np.uintp((column >> 1) * width + (place[k] - column * n_sides >> 1))
        if number[at] == 0:
            places[n], number[at] = at, n + 1
            n += 1
        block[k] = own = np.uintp(number[at] - 1)
        for i in range(np.uintp(plain.SUMS)):
            blocks[own, i] += sums[k, i]
    for b in range(n):
        square[b] = plain.slope_square(blocks[b])
    return block, places[:n], blocks[:n], square


@jit()
def _select_tall(tiles: Tiles, height: float, label: LabelConfig) -> tuple[CellArray, CellArray]:
    """List the tiles to examine, (K,), and the place of each in the list, or `OUTSIDE`."""
    extremes, n_tiles, n_tall = tiles.extremes, len(tiles.extremes), 0
    tall, number = np.empty(n_tiles, np.int32), np.full(n_tiles, OUTSIDE, np.int32)
    for t in range(n_tiles):
        low, high = np.float64(extremes[t, 0]), np.float64(extremes[t, 1])
        if plain.is_examined(high - low, low + height, tiles.place[t], label):
            tall[n_tall], number[t] = t, n_tall
            n_tall += 1
    return tall[:n_tall], number


@jit()
def _sum_returns(
    columns: PointArray,
    tiles: Tiles,
    tall: CellArray,
    tile_size: float,
    height: float,
    label: LabelConfig,
    number: CellArray,
) -> FloatArray:
    """Sum over the lowest returns, (3, N), of tall tiles, and over those above: (2 * K, SUMS)."""
    n_sides, sums = int(math.sqrt(len(tiles.at))), np.zeros((2 * len(tall), plain.SUMS))
    half, origin = 0.5 * n_sides * tile_size, np.empty((len(tall), 3))
    for k in range(len(tall)):
        place = tiles.place[tall[k]]
        # A division of whole numbers takes longer.
        column = np.int32((place + 0.5) / n_sides)
        # About a point near the tile: about the sensor, rounding would exceed the scatter.
        origin[k, 0] = plain.in_units((column & plain.FIRST) * tile_size - half)
        origin[k, 1] = plain.in_units((place - column * n_sides & plain.FIRST) * tile_size - half)
        origin[k, 2] = tiles.extremes[tall[k], 0]
    foot_height, max_height = label.ground_tolerance, label.obstacle_max_height
    x, y, z, tile = columns[0], columns[1], columns[2], tiles.tile
    for i in range(len(tile)):
        if tile[i] == OUTSIDE:
            continue
        k = number[np.uintp(tile[i])]
        if k == OUTSIDE:
            continue
        own = np.uintp(k)
        above = np.float64(z[i]) - origin[own, 2]
        if above > max_height:
            continue
        dx = plain.in_units(np.float64(x[i]) - origin[own, 0])
        dy = plain.in_units(np.float64(y[i]) - origin[own, 1])
        dz = plain.in_units(np.float64(z[i]) + height)
        # No branch: whether a return is one of the lowest is unpredictable.
        s = sums[np.uintp(2 * k + np.int32(above > foot_height))]
        s[0] += 1.0
        s[1] += dx
        s[2] += dy
        s[3] += dz
        s[4] += dx * dx
        s[5] += dy * dy
        s[6] += dz * dz
        s[7] += dx * dy
        s[8] += dx * dz
        s[9] += dy * dz
    return sums
