"""Compiled twin of `gp_ground_seg.core.pipeline.labels`, in seven calls.

`fit_pieces` prepares the surface of each cell, `survey` measures the heights of a part of the
points over it, `set_bands` turns the sums of all parts into bands, `label_part` labels a part.
For the votes `place_voxels` comes before that, and then `add_up_votes` and `settle_part`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.compiled.threads import Part, points_of
from gp_ground_seg.core.frame import (
    NOT_FINITE,
    BoolArray,
    CellArray,
    Faces,
    FloatArray,
    GroundSurface,
    IntArray,
    Label,
    Labelled,
    Scan,
    Tiles,
    line_between,
)
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import LabelConfig
from gp_ground_seg.core.pipeline.labels import (
    N_LAYERS,
    THREE_BY_THREE,
    band_margin,
    face_margin,
    ground_band,
    is_near,
    layer_of,
    roughness_of,
    settled_margin,
    shows_obstacle,
    vote_of,
)

# Plain integers, as compiled code has no enumerations.
_UNKNOWN, _GROUND, _OBSTACLE = int(Label.UNKNOWN), int(Label.GROUND), int(Label.OBSTACLE)
OBSTACLE_FLAG = 2**32
"""Added to the number of returns near the surface for each that shows an obstacle: more than there
are points."""
NO_VOXEL = -1


class LabelBuffers(NamedTuple):
    """Working arrays of the labels; the last row of each is for points in no cell.

    Attributes
    ----------
    pieces : (M * n_bins + 1, 2) float64
        Surface in each cell, level and slope over range.
    sums : (n_parts, M * n_bins + 1, 2) int64
        For each cell the number of points near the surface, with `OBSTACLE_FLAG` added for
        each that shows an obstacle, and the sum of squared heights in whole units. Their
        order does not matter, nor how the points are split.
    band : (M * n_bins + 1,) float64
        Largest height of ground [m].
    units : float
        Whole units of squared heights [1/m^2].
    """

    pieces: FloatArray
    sums: IntArray
    band: FloatArray
    units: float


@jit(entry=True)
def fit_pieces(surface: GroundSurface, buffers: LabelBuffers) -> None:
    """Line of the surface across each cell; NaN in the last row."""
    knots, mean, pieces = surface.knots, surface.mean, buffers.pieces
    n_bins = len(knots) - 1
    for m in range(len(mean)):
        for n in range(n_bins):
            piece = line_between(knots[n], knots[n + 1], mean[m, n], mean[m, n + 1])
            pieces[m * n_bins + n, 0], pieces[m * n_bins + n, 1] = piece
    pieces[len(pieces) - 1, 0] = pieces[len(pieces) - 1, 1] = math.nan


@jit(entry=True)
def survey(
    part: Part,
    scan: Scan,
    is_face: BoolArray,
    config: LabelConfig,
    height: FloatArray,
    buffers: LabelBuffers,
) -> None:
    """Heights of the points of a part over the surface, and the sums for roughness."""
    pieces, sums, nearest = buffers.pieces, buffers.sums[part.number], scan.grid.edges[0]
    for k in range(len(sums)):
        sums[k, 0] = sums[k, 1] = 0
    # Slices, because indices from 0 on need no check for negative ones.
    points = points_of(part, len(height))
    z, tile, heights = scan.xyz.T[2, points], scan.tiles.tile[points], height[points]
    cell, r = scan.grid.cell[points], scan.grid.r[points]
    for i in range(len(cell)):
        c = np.uintp(cell[i] if cell[i] >= 0 else len(pieces) - 1)
        away = max(np.float64(r[i]), nearest)
        h = np.float64(z[i]) - (pieces[c, 0] + pieces[c, 1] * away)
        heights[i] = h
        if shows_obstacle(h, config):
            sums[c, 0] += OBSTACLE_FLAG
        elif is_near(h, config) and not is_face[np.uintp(tile[i])]:
            sums[c, 0] += 1
            sums[c, 1] += int(h * h * buffers.units + 0.5)


@jit(entry=True)
def set_bands(
    n_parts: int,
    config: LabelConfig,
    is_predictive: bool,
    sigma_n: float,
    buffers: LabelBuffers,
    roughness: FloatArray,
) -> None:
    """Roughness and band of each cell from the sums of all parts."""
    n_segments, n_bins = roughness.shape
    # Columns 0 and n_bins + 1 stay empty: there is nothing beside the first and last bin.
    number = np.empty(n_bins + 2, np.int64)
    squares = np.empty(n_bins + 2, np.int64)
    for m in range(n_segments):
        for n in range(n_bins + 2):
            number[n] = squares[n] = 0
        for index in range(n_parts):
            for k in range(-1, 2):
                first = (m + k + n_segments) % n_segments * n_bins
                for n in range(n_bins):
                    number[n + 1] += buffers.sums[index, first + n, 0]
                    squares[n + 1] += buffers.sums[index, first + n, 1]
        for n in range(n_bins):
            flagged = number[n] + number[n + 1] + number[n + 2]
            n_near, n_obstacles = flagged & (OBSTACLE_FLAG - 1), flagged >> 32
            total = squares[n] + squares[n + 1] + squares[n + 2]
            rough = roughness_of(total, n_near, buffers.units)
            band = config.ground_tolerance
            if is_predictive:
                band = ground_band(n_near, rough, n_obstacles, config, sigma_n)
            buffers.band[m * n_bins + n] = band
            roughness[m, n] = rough
    buffers.band[n_segments * n_bins] = math.nan


class Voxels(NamedTuple):
    """Votes in voxels, see `gp_ground_seg.core.pipeline.labels.mean_votes`.

    Attributes
    ----------
    columns : (T, 2) int32
        First voxel of each occupied tile, and their number; the lowest and the highest are empty.
    of_point : (N,) int32
        Voxel of each point that votes, or `NO_VOXEL`.
    votes : (n_parts, V, 2) int64
        Number and sum of the votes in each voxel, of the points of each part [units].
    about : (V, 2) int64
        The same in each voxel and the 26 around it, of all points.
    """

    columns: CellArray
    of_point: CellArray
    votes: IntArray
    about: IntArray


@jit(entry=True)
def place_voxels(tiles: Tiles, tolerance: float, columns: CellArray) -> int:
    """Fill in the columns of `Voxels`; return the number of voxels."""
    n = 0
    for tile in tiles.occupied:
        t = np.uintp(tile)
        base = layer_of(np.float64(tiles.extremes[t, 0]), tolerance)
        top = layer_of(np.float64(tiles.extremes[t, 1]), tolerance)
        columns[t, 0], columns[t, 1] = n, int(min(top - base + 1.0, float(N_LAYERS))) + 2
        n += columns[t, 1]
    return n


@jit(entry=True)
def label_part(
    part: Part,
    scan: Scan,
    faces: Faces,
    config: LabelConfig,
    depth: float,
    band: FloatArray,
    voxels: Voxels,
    result: Labelled,
) -> None:
    """Label the points of a part from their heights in `result`, and add up their votes.

    Ground reaches `depth` below the surface. Without voxels there are no votes.
    """
    votes, tolerance = voxels.votes[part.number], config.ground_tolerance
    for v in range(len(votes)):
        votes[v, 0] = votes[v, 1] = 0
    points = points_of(part, len(result.height))
    z, tile, cell = scan.xyz.T[2, points], scan.tiles.tile[points], scan.grid.cell[points]
    height, label, margins = result.height[points], result.label[points], result.margin[points]
    of_point = voxels.of_point[points]
    for i in range(len(cell)):
        n, h, high = cell[i], height[i], np.float64(z[i])
        margin = band_margin(h, band[np.uintp(n if n >= 0 else len(band) - 1)], depth)
        t = np.uintp(tile[i] if n >= 0 else 0)
        lowest = np.float64(scan.tiles.extremes[t, 0])
        if faces.is_face[t]:
            margin = face_margin(margin, high - lowest, faces.has_occluded_base[t], tolerance)
        margins[i] = margin
        otherwise = _UNKNOWN if n == NOT_FINITE else _OBSTACLE
        label[i] = _GROUND if margin >= 0.0 else otherwise
        of_point[i] = NO_VOXEL
        if len(votes) > 0 and n >= 0 and is_near(h, config):
            layer = layer_of(high, tolerance) - layer_of(lowest, tolerance)
            if layer < N_LAYERS:
                v = voxels.columns[t, 0] + 1 + int(layer)
                of_point[i] = v
                votes[np.uintp(v), 0] += 1
                votes[np.uintp(v), 1] += int(vote_of(margin, tolerance))


@jit(entry=True)
def add_up_votes(n_parts: int, tiles: Tiles, tolerance: float, voxels: Voxels) -> None:
    """Add up the votes of all parts, then those of three layers, then those of nine tiles."""
    columns, votes, about = voxels.columns, voxels.votes[0], voxels.about
    for k in range(2):
        below = here = np.int64(0)
        for v in range(len(votes)):
            above = np.int64(0)
            for index in range(n_parts):
                above += voxels.votes[index, v, k]
            if v > 0:
                votes[v - 1, k] = below + here + above
            below, here = here, above
        # The last voxel stays as it is: the empty one over the last column.
    about[:] = 0
    n_sides = int(math.sqrt(len(columns)))
    for tile in tiles.occupied:
        t = np.uintp(tile)
        first, n_voxels, base = columns[t, 0], columns[t, 1], _base(tiles, tile, tolerance)
        for i in range(len(THREE_BY_THREE)):
            across = tile // n_sides + THREE_BY_THREE[i][0]
            along = tile % n_sides + THREE_BY_THREE[i][1]
            if not (0 <= across < n_sides and 0 <= along < n_sides):
                continue
            o = np.uintp(across * n_sides + along)
            if tiles.extremes[o, 0] > tiles.extremes[o, 1]:  # an empty tile
                continue
            up = base - _base(tiles, o, tolerance)
            for k in range(max(0, -up), min(n_voxels, columns[o, 1] - up)):
                here, there = np.uintp(first + k), np.uintp(columns[o, 0] + k + up)
                about[here, 0] += votes[there, 0]
                about[here, 1] += votes[there, 1]


@jit()
def _base(tiles: Tiles, tile: int, tolerance: float) -> int:
    """Layer of the lowest point of a tile."""
    return int(layer_of(np.float64(tiles.extremes[np.uintp(tile), 0]), tolerance))


@jit(entry=True)
def settle_part(part: Part, voxels: Voxels, metres_per_unit: float, result: Labelled) -> None:
    """Change margins and labels of the points of a part by the mean votes about them."""
    points = points_of(part, len(result.height))
    label, margins, of_point = result.label[points], result.margin[points], voxels.of_point[points]
    for i in range(len(of_point)):
        if of_point[i] != NO_VOXEL:
            v = np.uintp(of_point[i])
            mean = voxels.about[v, 1] / voxels.about[v, 0] * metres_per_unit
            margins[i] = settled_margin(margins[i], mean)
            label[i] = _GROUND if margins[i] >= 0.0 else _OBSTACLE
