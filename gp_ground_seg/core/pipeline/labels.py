"""Stage 6: labels from the height of each point over the surface, and p_ground."""

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import (
    NOT_FINITE,
    OUTSIDE,
    BoolArray,
    Faces,
    FloatArray,
    GroundSurface,
    IntArray,
    Label,
    Labelled,
    PointArray,
    Scan,
    Tiles,
    Values,
    as_index,
    at_points,
)
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import Config, LabelConfig
from gp_ground_seg.core.pipeline.relief import Relief
from gp_ground_seg.core.pipeline.roughness import ground_roughness
from gp_ground_seg.core.pipeline.vertical_faces import is_flat

HIGHEST_GROUND = 0.5
"""Height over the surface from which no return is ground, however rough the ground is [m]; returns
below it tell how rough it is. In proportion to the height of a sensor from 1 m down to 0.5 m: near
a small robot, most of what is low may be furniture."""
FINEST_UNITS = 2.0**40
"""Most of `sum_units`."""
ROUGHNESS_IN_BAND = 2.1
"""Height over the surface up to which a return is ground, in roughnesses of the ground about it:
of returns spread evenly over the height of grass all are within 1.7, of those normally distributed
98 in 100 are within 2.1."""
RETURN_NOISE = 0.02
"""Standard deviation of the height of a single return by the noise of the sensor [m]."""
FACE_SHARE, ROUGH_FOOT = 0.5, 0.05
"""Part of the tolerance up to which a return over the lowest of a vertical face is ground before
the vote, and up to which height it is where the ground about it is rough [m]."""
LAYERS_PER_TOLERANCE = 4.0
N_LAYERS = 64
"""Layers of a tile, after which they are counted from the first again: returns near the surface
lie closer together."""
VOTE_UNITS = 2.0**12
"""Whole units of a vote: the order in which they are added does not matter."""


def label_points(
    scan: Scan, faces: Faces, surface: GroundSurface, relief: Relief, height: float, config: Config
) -> Labelled:
    """Label points by their height over the surface (paper, Algorithm 2, line 14).

    A point within the paper's tolerance is ground; above it, the roughness of the ground about it
    decides (see `ground_band`, and `highest_ground` for a sensor at a `height` [m]); below the
    surface there is no obstacle, down to ``label.obstacle_max_height``, or by the rule tolerance
    down to that. Of a tile with a vertical face only returns in a flat cell, and near its lowest
    one, are ground; none are where the base is occluded. Then the returns near the surface vote
    (see `mean_votes`).
    """
    grid, tiles, label = scan.grid, scan.tiles, config.label
    by_roughness, dtype = label.rule == 'roughness', scan.xyz.dtype
    # NaN outside, as is what follows; tiles there are negative, which index the last row.
    x, y, z = scan.xyz.T
    over = z - at_points(surface.knots, surface.mean, grid)
    if not relief.is_level:
        over -= relief.at(x, y)
    highest = highest_ground(height)
    near, tile = np.flatnonzero(is_near(over, highest)), as_index(tiles.tile)
    roughness = np.zeros(len(faces.is_face))
    if by_roughness:
        units = sum_units(len(over))
        sums = near_sums(over[near], tile[near], faces.is_face, units)
        roughness = ground_roughness(tiles, sums, units)
    band = ground_band(roughness, highest, label).astype(dtype)
    lowest = np.append(tiles.extremes[:, 0].astype(np.float64), 0.0)
    top = top_of_face(roughness, lowest, faces.has_occluded_base, label)
    is_in_flat = is_flat(scan.extent, label.ground_tolerance)[as_index(grid.cell)]
    is_limited = faces.is_face[tile] & (faces.has_occluded_base[tile] | ~is_in_flat)
    top = np.where(is_limited, top.astype(dtype)[tile], np.inf).astype(dtype)
    depth = label.obstacle_max_height if by_roughness else label.ground_tolerance
    with np.errstate(invalid='ignore'):  # points outside may be infinitely high
        margin: PointArray = margin_of(over, z, band[tile], top, depth)
    if by_roughness:
        heights = z[near].astype(np.float64) - lowest_of(surface)
        voters, means = mean_votes(near, heights, margin, tiles, label.ground_tolerance)
        margin[voters] = margin_after_vote(margin[voters].astype(np.float64), means)
    result = np.where(margin >= 0.0, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    result[grid.cell == NOT_FINITE] = Label.UNKNOWN
    return Labelled(result, over, margin)


def highest_ground(height: float) -> float:
    """Largest height of rough ground over the surface for a sensor at a `height` [m]."""
    return min(max(height, 0.5), 1.0) * HIGHEST_GROUND


@shared
def is_near(height: Values, highest: float) -> Values:
    """Whether a return so high over the surface [m] tells its roughness."""
    return (height < highest) & (height >= -highest)


@shared
def ground_band(roughness: Values, highest: float, label: LabelConfig) -> Values:
    """Largest height of ground over the surface, where the ground is so rough [m].

    See `gp_ground_seg.core.pipeline.roughness.ground_roughness`: an object on the ground does
    not widen the band, since it fills few of the tiles about it.
    """
    likely = np.minimum(ROUGHNESS_IN_BAND * roughness, highest)
    return np.maximum(likely, label.ground_tolerance)


@shared
def top_of_face(
    roughness: Values, lowest: Values, is_occluded: Values, label: LabelConfig
) -> Values:
    """Height up to which returns of a vertical face are ground, about its lowest one [m]."""
    by_roughness = np.minimum(ROUGHNESS_IN_BAND * roughness, ROUGH_FOOT)
    foot = np.maximum(by_roughness, FACE_SHARE * label.ground_tolerance)
    # With a limit below the lowest no return of the tile is ground; the margin stays a distance.
    return lowest + foot * (1.0 - 2.0 * is_occluded)


@shared
def margin_of(height: Values, z: Values, band: Values, top: Values, depth: Values) -> Values:
    """Distance of a point to the nearest edge of what is ground [m], negative outside it.

    Ground reaches `depth` below the surface and `band` above it, and not above `top`, which is
    infinite where there is no vertical face. NaN without a surface.
    """
    to_upper, to_lower, to_top = band - height, height + depth, top - z
    margin = choose(to_upper < to_lower, to_upper, to_lower)
    return choose(to_top < margin, to_top, margin)


def lowest_of(surface: GroundSurface) -> float:
    """Lowest height of the surface [m], from which layers of votes are counted; NaN without one.

    Where the origin of the heights lies does not matter.
    """
    return float(np.fmin.reduce(surface.mean, axis=None))


@shared
def layer_of(over_lowest: Values, tolerance: float) -> Values:
    """Layer, below `N_LAYERS`, of a height over that of `lowest_of` [m]."""
    layer = np.floor(over_lowest * (LAYERS_PER_TOLERANCE / tolerance) + 0.5)
    return layer - N_LAYERS * np.floor(layer / N_LAYERS)


@shared
def vote_of(margin: Values, tolerance: float) -> Values:
    """Vote of a return in whole units: its margin, at most the tolerance either way."""
    share = margin / tolerance
    share = choose(share < -1.0, -1.0, choose(share > 1.0, 1.0, share))
    return whole_units(share, VOTE_UNITS)


@shared
def margin_after_vote(margin: Values, mean: Values) -> Values:
    """Margin of a return after the vote [m].

    The mean about it decides between ground and obstacle; its own margin counts where it is
    larger on that side.
    """
    lower, upper = choose(margin < mean, margin, mean), choose(margin < mean, mean, margin)
    return choose(mean >= 0.0, upper, lower)


def mean_votes(
    voters: IntArray, over_lowest: FloatArray, margin: PointArray, tiles: Tiles, tolerance: float
) -> tuple[IntArray, FloatArray]:
    """Mean vote about each return near an obstacle.

    Returns side by side at one height are mostly of one kind: a low return of a fence, or one of a
    bank that is too high for its cell, is judged with those about it. In each tile with a return
    that is no ground, a return counts the votes (see `vote_of`) of this tile and the eight around
    it, in its layer, the one above and the one below.

    The points near the surface vote, `voters` (V,); `over_lowest` (V,) are their heights over
    `lowest_of`, `margin` (N,) the margins of all points before the vote [m].

    Returns those in such a tile, (W,), and the means of the votes that they count, (W,) [m].
    """
    has_obstacle, counts = np.zeros((2, len(tiles.place)), dtype=np.bool_)
    tile = as_index(tiles.tile[voters])
    has_obstacle[tile[np.flatnonzero(margin[voters] < 0.0)]] = True
    about_tile = tiles.around()
    beside = about_tile[has_obstacle]
    counts[beside[beside != OUTSIDE]] = True
    # Most voters are in none of these tiles.
    is_counted = counts[tile]
    voters, over_lowest, tile = voters[is_counted], over_lowest[is_counted], tile[is_counted]
    # The last row, whose index `OUTSIDE` is, is that of tiles without votes.
    rows = np.full(len(tiles.place) + 1, np.count_nonzero(counts))
    rows[np.flatnonzero(counts)] = np.arange(rows[-1])
    # Layers of a row stand between copies of the last and of the first one.
    shape = rows[-1] + 1, N_LAYERS + 2
    layer = layer_of(over_lowest, tolerance).astype(np.int64)
    entry = rows[tile] * shape[1] + layer + 1
    is_changed = has_obstacle[tile]
    tile, layer = tile[is_changed], layer[is_changed]
    about = [rows[other] * shape[1] + layer for other in about_tile[tile].T]

    def total(weights: FloatArray | None) -> FloatArray:
        """Sum of the votes about the voters to change: of three layers, from the lowest on."""
        layers = np.bincount(entry, weights, shape[0] * shape[1]).reshape(shape)
        layers[:, 0], layers[:, -1] = layers[:, -2], layers[:, 1]
        flat = layers.ravel()
        three = flat[:-2] + flat[1:-1]
        three += flat[2:]
        sums: FloatArray = sum(three[entries] for entries in about)
        return sums

    votes = vote_of(margin[voters].astype(np.float64), tolerance)
    mean = total(votes) / total(None)
    return voters[is_changed], mean * (tolerance / VOTE_UNITS)


def near_sums(height: PointArray, tile: IntArray, is_face: BoolArray, units: float) -> FloatArray:
    """Count returns in each tile, and sum their squared heights in whole units, (2, T).

    `height` (P,) is over the surface [m]; vertical faces are no roughness of the ground.
    """
    n_tiles, squares = len(is_face) - 1, np.square(height.astype(np.float64))
    sums = np.empty((2, n_tiles))
    sums[0] = np.bincount(tile, minlength=n_tiles)
    sums[1] = np.bincount(tile, whole_units(squares, units), n_tiles)
    sums[:, is_face[:-1]] = 0.0
    return sums


@shared
def whole_units(value: Values, units: float) -> Values:
    """Round a value to whole units."""
    return np.floor(value * units + 0.5)


def sum_units(n_points: int) -> float:
    """Whole units that squared heights of returns near the surface are rounded to [1/m^2].

    The order in which whole numbers are summed does not matter. Even if each return is as far from
    the surface as `is_near` allows, their number in the highest bits, see `number_shift`, and
    the sum below it fit into 63 bits.
    """
    return min(FINEST_UNITS, 2.0 ** (65 - 2 * n_points.bit_length()))


def number_shift(n_points: int) -> int:
    """Bits of the sum of squares below the number of returns, where one integer holds both."""
    return 63 - n_points.bit_length()


def ground_probability(margin: FloatArray, std: FloatArray) -> npt.NDArray[np.float32]:
    """Probability that each point is ground: that its height lies within the band of ground.

    The height over the surface is uncertain by the standard deviation of the surface, `std` (N,)
    [m], and by `RETURN_NOISE`; how far ground lies from the surface is in the band.

    For `margin` (N,) see `Labelled.margin` [m]. Returns (N,), at least 0.5 where the margin is not
    negative; 0 where it is NaN.
    """
    from scipy.special import ndtr

    spread = np.sqrt(std**2 + RETURN_NOISE**2)
    result: npt.NDArray[np.float32] = np.nan_to_num(ndtr(margin / spread)).astype(np.float32)
    return result
