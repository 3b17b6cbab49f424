"""Stage 3: what is no ground by the scatter of its returns: vertical faces, plants and stairs.

A band about the ground cannot separate the base of a wall from the ground before it. The
returns above the base can: together they form a vertical surface. The base of a face is
occluded where something stands before it, or where the rings of the sensor miss the strip of
ground in its tile; the lowest return of the tile then belongs to the face. A polar cell that is
flat shows ground beside the face: near the sensor cells are finer than tiles.

Terrain is smooth: the returns of a tile lie on a plane. Those of a bush or of stairs do not.
Raised tiles are no ground either where many around them scatter more than the own level does.
"""

import numpy as np

from gp_ground_seg.core.frame import (
    OUTSIDE,
    BoolArray,
    CellArray,
    Faces,
    FloatArray,
    IntArray,
    Scan,
    Values,
    as_index,
)
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import Config, FacesConfig, LabelConfig
from gp_ground_seg.core.pipeline.points import FARTHEST
from gp_ground_seg.core.pipeline.roughness import (
    N_LEVELS,
    ROUGHNESS,
    SQUARE_EDGES,
    UNKNOWN,
    UNKNOWN_LEVEL,
    Window,
    level_at,
    levels_about,
)
from gp_ground_seg.core.pipeline.terrain import MAX_SLOPE, mark_beyond_edges

MIN_RETURNS = 4
"""Returns that a tile needs to have an orientation."""
FLATNESS = 1e-9
"""Scatter across a line, in parts of that along it, or of each return [m^2], which is none: as
wide as coordinates are rounded to. What is left is rounding, and has no orientation."""
FIRST = ~3
"""Mask of the column and row of a tile: those of the first in its block of four by four."""
UNITS_PER_METRE = 2.0**16
"""Coordinates are rounded to units of 15 um: squares and products within a block of tiles, and
sums of two thousand of them, are exact up to 30 m over the own level: no order matters."""
MIN_WIDTH, ONE_RING = 0.05, 0.001**2
"""Least standard deviation of the returns of a tile, in all directions but one, of which the
scatter about their plane is known [m]; square of that up to which it tells nothing of the own
level [m^2]: a ring lies in the plane of its rays, however rough the ground is."""
SCATTER = 0.25 * ROUGHNESS
SQUARE_SCATTERS = SQUARE_EDGES / 16.0
"""Scatter about a plane of each level of `gp_ground_seg.core.pipeline.roughness`, and the squares
between them [m, m^2]."""
SCATTERED = Window(2, 0.75, 4)
"""Window of the raised tiles among which many may scatter: of 6 m, for tiles of 0.5 m."""
SMOOTH, TIMES_OWN, OWN_SHARE = 0.0265, 4.5, 0.75
"""Scatter up to which terrain is smooth [m]: that of KITTI has 0.003 to 0.02, beds and stairs 0.03
to 0.06; what it may be as a multiple of that of the own level, of which this share is smoother."""
STEPS, AS_EVEN = (0.0215, 0.05), 1.2
"""Least and largest scatter of stairs about their plane [m], of steps of 0.1 to 0.2 m; most that
it is over 2 m, as a multiple of that over 1 m: of stairs 1.0 to 1.2, of rough banks 1.5."""
STAIRS_UP = 0.76, 0.94
"""Vertical components of the normal of what is as steep as stairs: 20 to 41 degrees."""
SAMPLED, OWN_BAND = 2, 0.6
"""One in so many tiles of the own level tells how much it scatters; height up to which a tile is
of it, either way, in heights of a face: with 1 beds are, with 0.5 little of rough land is."""

SUMS = 10
"""Rows of the sums over returns: number, x, y, z, their squares, x y, x z, y z."""


def find_faces(scan: Scan, height: float, config: Config) -> Faces:
    """Find the tiles that hold a vertical face, or are of a plant or stairs; those show no ground.

    The scatter of the returns of a tile determines their orientation, see `normal_z`; those higher
    than ``label.obstacle_max_height`` above the lowest may overhang, and are left out. The own
    level is `height` [m] below the origin.
    """
    tiles, faces, label = scan.tiles, config.faces, config.label
    result, n_sides = Faces.none(tiles), tiles.n_sides
    lowest_z, highest_z = tiles.extremes.astype(np.float64).T
    # Most returns are in tiles where nothing stands, and are left out.
    extent, over = highest_z - lowest_z, lowest_z + height
    tall = np.flatnonzero(is_examined(extent, over, tiles.place, label))
    extent, over, lowest_z = extent[tall], over[tall], lowest_z[tall]
    # One more than there are tiles: `OUTSIDE` is the index of the last.
    row_of_tile = np.full(len(result.is_face), OUTSIDE)
    row_of_tile[tall] = np.arange(len(tall))
    row = row_of_tile[as_index(tiles.tile)]
    used = np.flatnonzero(row != OUTSIDE)
    above = scan.xyz[used, 2].astype(np.float64) - lowest_z[row[used]]
    low = np.flatnonzero(above <= label.obstacle_max_height)
    used, above = used[low], above[low]
    row, z = row[used], scan.xyz[used, 2].astype(np.float64) + height
    # Relative to a point near the tile: about the sensor, rounding would exceed the scatter.
    x, y = (
        scan.xyz[used, i]
        - in_units((place & FIRST) * faces.cell_size - 0.5 * n_sides * faces.cell_size)[row]
        for i, place in enumerate(np.divmod(tiles.place[tall], n_sides))
    )
    # Rows of the foot first, then those of the rest.
    is_rest = above > label.ground_tolerance
    sums = _sums(x, y, z, row + len(tall) * is_rest, 2 * len(tall))
    foot, rest = sums[:, : len(tall)], sums[:, len(tall) :]
    whole, reaches = foot + rest, extent > face_height(label)
    result.is_face[tall] = reaches & is_vertical(whole, faces)
    result.is_steep[tall] = reaches & is_steep(rest)
    result.has_occluded_base[tall] = result.is_face[tall] & is_base_occluded(foot, rest, faces)
    result.has_occluded_base[_with_flat_foot(scan, label.ground_tolerance)] = False
    is_face, place = result.is_face[tall], tiles.place[tall]
    rough = tall[_scattered(place, n_sides, whole, is_face, extent, over, label)]
    result.is_face[rough] = result.has_occluded_base[rough] = True
    mark_beyond_edges(scan.candidates, height, face_height(label), result)
    return result


def _with_flat_foot(scan: Scan, tolerance: float) -> CellArray:
    """Tiles of whose lowest returns some are in a flat cell, with repetitions."""
    candidates = scan.candidates
    is_foot = candidates.z - scan.tiles.extremes[candidates.tile, 0] <= tolerance
    cell = candidates.segment * scan.grid.n_bins + candidates.bin
    result: CellArray = candidates.tile[is_foot & is_flat(scan.extent[cell], tolerance)]
    return result


def _scattered(
    place: CellArray,
    n_sides: int,
    sums: FloatArray,
    is_face: BoolArray,
    extent: FloatArray,
    over: FloatArray,
    label: LabelConfig,
) -> IntArray:
    """List the tiles, of those at a `place` (K,), that are raised, and among many that scatter.

    `sums`, (SUMS, K), are over their returns; for the others see `is_examined`.
    """
    square, face = scatter_square(sums), face_height(label)
    is_known = ~is_face & is_of_own_level(extent, over, label) & (square > ONE_RING)
    level = np.searchsorted(SQUARE_SCATTERS, square[is_known], side='right')
    counts = np.bincount(level, minlength=N_LEVELS)[None, :]
    limit = smooth_up_to(SCATTER[level_at(counts, OWN_SHARE)[0]])
    raised = np.flatnonzero(~is_face & (over > 0.5 * face))
    place = place[raised]
    small, large = (_squares_of_blocks(place, n_sides, sums[:, raised], n) for n in (1, 2))
    vote = vote_on_scatter(square[raised], small, large, limit)
    about = levels_about(place, vote, n_sides, SCATTERED, 0)
    result: IntArray = raised[(vote != UNKNOWN_LEVEL) & (about > 0) & (over[raised] > face)]
    return result


def _squares_of_blocks(place: CellArray, n_sides: int, sums: FloatArray, shift: int) -> FloatArray:
    """Square of the scatter in the block of 2^shift tiles a side that each is in, (K,) [m^2].

    `sums` over the returns of tiles at a `place` (K,) are about one point in each block.
    """
    column, row = np.divmod(as_index(place), n_sides)
    _, own = np.unique((column >> shift) * n_sides + (row >> shift), return_inverse=True)
    square: FloatArray = slope_square(np.array([np.bincount(own, total) for total in sums]))
    return square[own]


@shared
def is_flat(extent: Values, tolerance: float) -> Values:
    """Whether a cell shows no vertical face: of several points, none much higher than another."""
    return (extent > 0.0) & (extent <= tolerance)


@shared
def is_examined(extent: Values, over: Values, place: Values, label: LabelConfig) -> Values:
    """Whether the scatter of a tile matters.

    Its highest return is `extent` above the lowest, and that is `over` the own level [m]: it is
    tall, or raised, or tells with others how much the own level scatters. Nothing is measured
    beyond `FARTHEST`: squares there may exceed all numbers.
    """
    face = face_height(label)
    is_sample = (place % SAMPLED == 0) & is_of_own_level(extent, over, label)
    return ((extent > face) | (over > 0.5 * face) | is_sample) & (np.abs(over) < FARTHEST)


@shared
def is_of_own_level(extent: Values, over: Values, label: LabelConfig) -> Values:
    """Whether the scatter of a tile may tell how much the own level does; see `is_examined`."""
    face = face_height(label)
    return (np.abs(over) < OWN_BAND * face) & (extent <= face)


@shared
def smooth_up_to(own: Values) -> Values:
    """Largest scatter of smooth terrain, where the own level has `own` [m]."""
    return np.maximum(SMOOTH, TIMES_OWN * own)


@shared
def face_height(label: LabelConfig) -> float:
    """Least height of a face over the lowest return of its tile [m].

    The lowest return may be of ground, which reaches as high as the tolerance.
    """
    return label.obstacle_min_height + label.ground_tolerance


@shared
def in_units(values: Values) -> Values:
    """Round to units of `UNITS_PER_METRE`."""
    return np.rint(values * UNITS_PER_METRE) / UNITS_PER_METRE


def _sums(x: FloatArray, y: FloatArray, z: FloatArray, row: IntArray, n_rows: int) -> FloatArray:
    """Add up the returns (P,) of each row, (SUMS, n_rows)."""
    x, y, z = map(in_units, (x, y, z))
    terms = np.ones(len(x)), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z
    return np.array([np.bincount(row, term, n_rows) for term in terms])


@shared
def moments(sums: FloatArray) -> tuple[Values, ...]:
    """Return the number of returns, and that times their scatter xx, yy, zz, xy, xz, yz [m^2].

    The sums are over the returns of a tile, (SUMS,), or (SUMS, T) of T tiles; coordinates are
    relative to any point of the tile [m].
    """
    n, x, y, z = sums[0], sums[1], sums[2], sums[3]
    inverse = 1.0 / n  # one division, which takes as long as ten multiplications
    mx, my, mz = x * inverse, y * inverse, z * inverse
    xx, yy, zz = sums[4] - mx * x, sums[5] - my * y, sums[6] - mz * z
    xy, xz, yz = sums[7] - mx * y, sums[8] - mx * z, sums[9] - my * z
    return n, xx, yy, zz, xy, xz, yz


@shared
def is_vertical(sums: FloatArray, faces: FacesConfig) -> Values:
    """Whether the returns of a tile form a vertical face; for the sums see `moments`."""
    n, xx, yy, zz, xy, xz, yz = moments(sums)
    return (n >= MIN_RETURNS) & (normal_z(xx, yy, zz, xy, xz, yz) < faces.max_normal_z)


@shared
def is_steep(rest: FloatArray) -> Values:
    """Whether the returns above the lowest of a tile rise more steeply than terrain.

    How far they lie on for each metre of height is a regression of x and y on z: foliage, and
    noise of the ranges, scatter these, and change it little. For the sums see `moments`.
    """
    n = np.maximum(rest[0], 1.0)
    zz = rest[6] - rest[3] * rest[3] / n
    xz, yz = rest[8] - rest[1] * rest[3] / n, rest[9] - rest[2] * rest[3] / n
    return (rest[0] >= MIN_RETURNS) & (MAX_SLOPE * MAX_SLOPE * (xz * xz + yz * yz) < zz * zz)


@shared
def scatter_square(sums: FloatArray) -> Values:
    """Mean square of the returns of a tile about the plane through them [m^2].

    It is the determinant of their scatter over the sum of its minors: nearly the least eigenvalue,
    as the two others are larger. `UNKNOWN` of few returns, and of those in a line.
    For the sums see `moments`.
    """
    n, xx, yy, zz, xy, xz, yz = moments(sums)
    a, b, c = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    minors = a + b + c
    determinant = xx * a - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    is_known = (n >= MIN_RETURNS) & (minors > n * MIN_WIDTH * MIN_WIDTH * (xx + yy + zz))
    square = np.maximum(determinant, 0.0) / (n * choose(is_known, minors, 1.0))
    return choose(is_known, square, UNKNOWN)


@shared
def slope_square(sums: FloatArray) -> Values:
    """Do what `scatter_square` does, of returns as steep as stairs; `UNKNOWN` of others."""
    _, xx, yy, zz, xy, xz, yz = moments(sums)
    up = normal_z(xx, yy, zz, xy, xz, yz)
    is_as_steep = (up > STAIRS_UP[0]) & (up < STAIRS_UP[1])
    return choose(is_as_steep, scatter_square(sums), UNKNOWN)


@shared
def vote_on_scatter(square: Values, small: Values, large: Values, limit: float) -> Values:
    """Whether a raised tile scatters more than terrain: 1, or 0, or `UNKNOWN_LEVEL`.

    Squares of the scatter are of the tile, and of blocks of 1 and 2 m [m^2]. A tile of stairs may
    show one step alone, but a block scatters as much as one twice as large: both lie on one plane.
    """
    least, most = STEPS[0] * STEPS[0], STEPS[1] * STEPS[1]
    even = np.minimum(most, AS_EVEN * AS_EVEN * small)
    is_stepped = (small > least) & (large > least) & (large < even)
    is_rough = is_stepped | (square > limit * limit)
    return choose(is_rough, 1, choose(square != UNKNOWN, 0, UNKNOWN_LEVEL))


@shared
def normal_z(xx: Values, yy: Values, zz: Values, xy: Values, xz: Values, yz: Values) -> Values:
    """Vertical part of the unit normal of points with the given scatter, in closed form.

    The adjugate of the scatter matrix is the sum of the outer products of its eigenvectors, each
    weighted by the product of the other two eigenvalues: the normal of a plane, the direction of
    least scatter, has nearly all the weight. The share of the vertical in its trace is the squared
    vertical part of the normal. Of a pole, both horizontal directions count; of a shapeless
    cluster, all three.

    It is 0 for vertical planes and poles, 1 for level planes, and 1 where there is no scatter, or
    only along a line.
    """
    vertical = np.maximum(xx * yy - xy * xy, 0.0)
    trace = vertical + np.maximum(yy * zz - yz * yz, 0.0) + np.maximum(xx * zz - xz * xz, 0.0)
    size = xx + yy + zz
    is_known = trace > FLATNESS * size * size
    return choose(is_known, np.sqrt(vertical / choose(is_known, trace, 1.0)), 1.0)


@shared
def is_base_occluded(foot: FloatArray, rest: FloatArray, faces: FacesConfig) -> Values:
    """Whether the lowest returns of a tile belong to its face, and are not ground before it.

    Ground would lie off the plane of the returns above. For the sums see `moments`. False
    where fewer than two returns are above the foot.
    """
    n_foot, n_rest = foot[0], np.maximum(rest[0], 1.0)
    x, y = rest[1] / n_rest, rest[2] / n_rest
    # Scatter of both about the middle of the returns above.
    xx = rest[4] - n_rest * x * x
    yy = rest[5] - n_rest * y * y
    xy = rest[7] - n_rest * x * y
    foot_xx = foot[4] - 2.0 * x * foot[1] + n_foot * x * x
    foot_yy = foot[5] - 2.0 * y * foot[2] + n_foot * y * y
    foot_xy = foot[7] - x * foot[2] - y * foot[1] + n_foot * x * y
    # Mean square along the direction in which the returns above scatter least.
    size = np.sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy)
    # Of returns in one place the direction would be rounding: all directions count alike.
    has_direction = size > FLATNESS * n_rest
    along = (foot_xx - foot_yy) * (xx - yy) + 4.0 * foot_xy * xy
    aligned = choose(has_direction, along / choose(has_direction, size, 1.0), 0.0)
    square = 0.5 * (foot_xx + foot_yy - aligned)
    limit = faces.max_foot_distance
    return (square <= n_foot * limit * limit) & (rest[0] >= 2.0) & (limit > 0.0)
