"""Bias and uncertainty of the surface, by the returns called ground.

The process is fitted to the lowest point of each bin, so it lies below the mean of the returns,
and its standard deviation follows from its hyper-parameters. The returns tell both. About each
knot they lie in up to six cells: the two of its segment that meet there, and theirs of the
segments beside it. With ``n_i`` returns of mean residual ``e_i`` in cell i, n in all, the mean of
the residuals is ``e = sum n_i e_i / n``, and by the law of total variance their variance is::

    V = B + W,  B = sum n_i (e_i - e)^2 / n,  W = sum n_i Var_i / n,

B between the cells and W within them. W is range noise, and roughness finer than a cell. V is the
variance of a return about the corrected surface. B is not yet that of the ground, as few cells
vary less about their own mean than about the ground, and their means are noisy. With ground of
variance G from cell to cell, and returns of variance W in C cells::

    E[B] = G (k - 1) / k + (C - 1) W / n,  k = n^2 / sum n_i^2,

where k is the effective number of cells. Where nearly all returns lie in one cell, k - 1 is near
0: V is then the first guess, as if ``PRIOR_CELLS`` more cells had it::

    G = (k max(B - (C - 1) W / n, 0) + PRIOR_CELLS V) / (k - 1 + PRIOR_CELLS).

The spread of few cells is itself uncertain: errors over it follow Student's distribution, of which
68 % lie within 1.3 with three cells. So G is multiplied by ``1 + 1 / (k - 1 + PRIOR_CELLS)``. The
variance of the ground about the corrected surface is that, and that of the mean, ``W / n``.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree

from gp_ground_seg.core.frame import (
    BoolArray,
    FloatArray,
    GroundSurface,
    Label,
    Labelled,
    PolarGrid,
    as_index,
)

PRIOR_CELLS = 0.05
"""Cells that the first guess of the ground's variance counts as much as."""
LEAST_STD = 1e-4
"""Standard deviation of the ground that is said at least: cells agree by chance [m]."""
HIDDEN, ABOUT, PRIOR_DISTANCE = 2.0, 15, 0.3
"""Steepness of what no beam saw, behind edges and objects, by what beams see; knots and segments
over which that is averaged; distance of two knots that tell as much as the prior [m]."""
PLACES = 2.0**15
"""Units that places are rounded to [1/m]: their squared distances are whole numbers below 2^53."""
UNITS = 2.0**20
"""Units that residuals are rounded to [1/m], as the order of whole numbers in a sum is free."""


class CorrectedSurface(NamedTuple):
    """Height of the ground at the knots of every segment, (M, K) each; NaN without a model."""

    knots: FloatArray  # (K,) ranges [m]: the bin edges
    correction: FloatArray  # what is added to the height that the process gives [m]
    mean: FloatArray  # height of the ground in the level frame [m]
    std: FloatArray  # standard deviation of the height of the ground [m]
    return_rms: FloatArray  # root mean square of the height of a return over the ground [m]


def correct_surface(
    surface: GroundSurface, labelled: Labelled, grid: PolarGrid, noise_std: float, slope_std: float
) -> CorrectedSurface:
    """Correct a surface by the residuals of the returns called ground.

    One cell does not show how ground varies from cell to cell: where the window has no other, the
    standard deviations are those of the process, without and with its noise.

    A knot is seen if one of the two cells that touch it has returns. The height at any other is
    estimated twice: by the process, and by the nearest knot that is seen, whose variance grows by
    ``(slope_std distance)^2``, the prior of the slope. The two are weighted by their inverse
    variances. The result is as uncertain as that knot, plus the variance between the two, and the
    rise over the distance by slopes `HIDDEN` times as steep as those about the knot.

    `noise_std` is that of the process [m], `slope_std` the prior standard
    deviation of the ground's slope.
    """
    has_model = np.isfinite(surface.mean)
    is_touched, sums = _sums(labelled, grid)
    n_cells, n_returns, squared_numbers, total, squares, squared_means = sums
    seen, unseen = is_touched & has_model, ~is_touched & has_model
    number = np.maximum(n_returns, 1.0)
    correction = np.where(seen, total / number, np.where(has_model, 0.0, np.nan))

    alone, tells = surface.std**2, seen & (n_cells >= 2.0)
    between = np.maximum(squared_means / number - correction**2, 0.0)
    noise = np.where(tells, np.maximum(squares - squared_means, 0.0) / number, noise_std**2)
    whole = np.where(tells, between, alone) + noise
    effective = np.where(tells, number**2 / np.maximum(squared_numbers, 1.0), 1.0)
    unbiased = _unbiased_variance(between, noise / number, whole, n_cells, effective)
    variance = np.where(tells, unbiased, alone)
    if seen.any() and unseen.any():
        distance, nearest = _nearest(surface.knots, seen, unseen)
        alone, apart = alone[unseen], (slope_std * distance) ** 2
        slopes = _slope_variance(surface.mean + correction, seen, surface.knots, slope_std)
        for table in (correction, variance, noise):
            table[unseen] = table[seen][nearest]
        near_mean = surface.mean[seen][nearest]
        difference = near_mean - surface.mean[unseen]
        weight = alone / np.maximum(alone + variance[unseen] + apart, np.finfo(float).tiny)
        correction[unseen] += weight * difference
        variance[unseen] += weight * (1.0 - weight) * difference**2
        variance[unseen] += slopes[seen][nearest] * (HIDDEN * distance) ** 2
        whole[unseen] = variance[unseen] + noise[unseen]
    mean, std = surface.mean + correction, np.maximum(np.sqrt(variance), LEAST_STD)
    # Returns lie on the ground: they depart from the surface no less than it.
    return_rms = np.maximum(np.sqrt(whole), std)
    return CorrectedSurface(surface.knots, correction, mean, std, return_rms)


def _slope_variance(
    height: FloatArray, seen: BoolArray, knots: FloatArray, slope_std: float
) -> FloatArray:
    """Mean square slope between knots side by side that are `seen`, about each knot, (M, K).

    Over `ABOUT` knots and segments, weighted by the squares of the distances; so is `slope_std`,
    the prior, by that of `PRIOR_DISTANCE`.
    """
    prior, sums = (PRIOR_DISTANCE / ABOUT) ** 2, np.zeros((2, *seen.shape))
    for axis in (0, 1):
        both = seen & np.roll(seen, 1, axis)
        both[:, 0] = False  # the last knot is not beside the first one
        for total, table in zip(sums, (height, _places(len(seen), knots)), strict=True):
            total += np.where(both, np.abs(table - np.roll(table, 1, axis)), 0.0) ** 2
    rises, steps = (uniform_filter(total, ABOUT, mode=('wrap', 'constant')) for total in sums)
    result: FloatArray = (rises + prior * slope_std**2) / (steps + prior)
    return result


def _unbiased_variance(
    between: FloatArray,
    noise_of_mean: FloatArray,
    whole: FloatArray,
    n_cells: FloatArray,
    effective: FloatArray,
) -> FloatArray:
    """Variance of the ground about the mean residual of cells [m^2], (M, K) as its arguments.

    B, W / n, V, C and k of the module's docstring.
    """
    own = np.maximum(between - (n_cells - 1.0) * noise_of_mean, 0.0)
    spare = effective - 1.0 + PRIOR_CELLS
    cell_to_cell = (effective * own + PRIOR_CELLS * whole) / spare
    variance: FloatArray = cell_to_cell * (1.0 + 1.0 / spare) + noise_of_mean
    return variance


def _sums(labelled: Labelled, grid: PolarGrid) -> tuple[BoolArray, tuple[FloatArray, ...]]:
    """Which knots are touched by a cell with returns called ground, and sums about them, (M, K).

    The sums are over six cells: cells with such returns, their number, over the cells of their
    squared number, the sum of their residuals [m], of the squares [m^2], and over the cells of
    number times squared mean [m^2].
    """
    # A plain integer: comparing with an enumeration is five times slower.
    is_ground = (labelled.label == int(Label.GROUND)) & grid.inside
    cell, residual = as_index(grid.cell[is_ground]), np.rint(labelled.height[is_ground] * UNITS)
    shape = grid.n_segments, grid.n_bins

    def by_cell(weights: FloatArray | None) -> FloatArray:
        return np.bincount(cell, weights, shape[0] * shape[1]).reshape(shape).astype(np.float64)

    number, total = by_cell(None), by_cell(residual) / UNITS
    squares = by_cell(residual**2) / UNITS**2
    occupied = (number > 0.0).astype(np.float64)
    tables = occupied, number, number**2, total, squares, total**2 / np.maximum(number, 1.0)
    rings = (np.roll(table, 1, 0) + table + np.roll(table, -1, 0) for table in tables)
    return _of_both_bins(occupied) > 0.0, tuple(map(_of_both_bins, rings))


def _of_both_bins(table: FloatArray) -> FloatArray:
    """Sum of the two bins that meet at each knot, (M, n_bins + 1)."""
    padded = np.pad(table, ((0, 0), (1, 1)))
    result: FloatArray = padded[:, :-1] + padded[:, 1:]
    return result


def _nearest(
    knots: FloatArray, seen: BoolArray, unseen: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Distance [m] of each knot of `unseen` to the nearest of `seen`, and which of them it is.

    Of segments to either side two are as near as each other. Rounding of sines, which differs from
    processor to processor, must not choose: squared distances of places on a raster are exact.
    """
    places = _places(len(seen), knots)
    raster = np.rint(np.stack([places.real, places.imag], axis=-1) * PLACES)
    # Not balanced: it is asked once, and takes half the time to build.
    tree = cKDTree(raster[seen], compact_nodes=False, balanced_tree=False)
    _, nearest = tree.query(raster[unseen])
    return np.abs(places[seen][nearest] - places[unseen]), nearest


def _places(n_segments: int, knots: FloatArray) -> npt.NDArray[np.complexfloating]:
    """Places of the knots of every segment, x + iy, (M, K) [m]."""
    azimuth = 2.0 * np.pi * np.arange(n_segments)[:, None] / n_segments
    return knots * np.cos(azimuth) + 1j * (knots * np.sin(azimuth))
