"""What the returns called ground say of the surface: its bias, and how far ground departs from it.

The process is fitted to the lowest point of each bin, so it lies below the mean of the returns, and
its standard deviation is that of a process whose hyper-parameters are given. The returns themselves
tell both. About each knot they lie in up to six cells: the two of its segment and theirs of the
segments beside it. With ``n_i`` returns of mean residual ``e_i`` in cell i, n in all, the residuals
have the mean ``e = sum n_i e_i / n``, and by the law of total variance their variance is

    sum n_i (e_i - e)^2 / n  +  sum n_i Var_i / n,

between the cells and within them. The first is how far the ground departs from the corrected
surface from cell to cell; the second is range noise, and roughness finer than a cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from gp_ground_seg.frame import BoolArray, FloatArray, GroundSurface, Label, Labelled, PolarGrid

UNITS = 2.0**20
"""Units that residuals are rounded to [1/m], as the order of whole numbers in a sum is free."""


class CorrectedSurface(NamedTuple):
    """Height of the ground at the knots of every segment, (M, K) each; NaN without a model."""

    knots: FloatArray  # (K,) ranges [m]: the bin edges
    correction: FloatArray  # what is added to the height that the process gives [m]
    mean: FloatArray  # height of the ground in the level frame [m]
    std: FloatArray  # standard deviation of the height of the ground [m]
    return_std: FloatArray  # standard deviation of the height of a return from the ground [m]


def correct_surface(
    surface: GroundSurface,
    labelled: Labelled,
    grid: PolarGrid,
    noise_std: FloatArray,
    slope_std: float,
) -> CorrectedSurface:
    """Correct a surface by the residuals of the returns called ground.

    One cell does not show how ground varies from cell to cell: there the standard deviations are
    those of the process. Knots without returns take the correction of the nearest knot that has
    some; their variance is the larger of its and the process's own, plus
    ``(slope_std distance)^2``, what the prior of the slope gives away from evidence.

    Parameters
    ----------
    surface : GroundSurface
        Height of the ground by the process.
    labelled : Labelled
        Labels, and heights over `surface`.
    grid : PolarGrid
        Cells of the points.
    noise_std : (M, 1) float64
        Standard deviation of the process's noise in each segment [m].
    slope_std : float
        Prior standard deviation of the ground's slope.
    """
    has_model = np.isfinite(surface.mean)
    n_cells, n_returns, total, squares, squared_means = _sums_about_knots(labelled, grid)
    number = np.maximum(n_returns, 1.0)
    correction = total / number
    variance = np.maximum(squared_means / number - correction**2, 0.0)
    noise = np.maximum(squares - squared_means, 0.0) / number

    own, tells = surface.std**2, n_cells >= 2.0
    variance = np.where(tells & has_model, variance, own)
    noise = np.where(tells, noise, noise_std**2)
    seen, unseen = (n_returns > 0.0) & has_model, (n_returns == 0.0) & has_model
    if seen.any() and unseen.any():
        distance, nearest = _nearest(surface.knots, seen, unseen)
        for table in (correction, variance, noise):
            table[unseen] = table[seen][nearest]
        variance[unseen] = np.maximum(variance[unseen], own[unseen]) + (slope_std * distance) ** 2
    mean, std = surface.mean + correction, np.sqrt(variance)
    return CorrectedSurface(surface.knots, correction, mean, std, np.sqrt(variance + noise))


def _sums_about_knots(labelled: Labelled, grid: PolarGrid) -> tuple[FloatArray, ...]:
    """Sums over the cells about each knot, (M, K) each.

    Cells with returns called ground, their number, the sum of their residuals [m] and of the
    squares [m^2], and the sum over cells of number times squared mean [m^2].
    """
    is_ground = (labelled.label == Label.GROUND) & grid.inside
    cell, residual = grid.cell[is_ground], np.rint(labelled.height[is_ground] * UNITS)
    shape = grid.n_segments, grid.n_bins

    def by_cell(weights: FloatArray | None) -> FloatArray:
        return np.bincount(cell, weights, shape[0] * shape[1]).reshape(shape).astype(np.float64)

    number, total = by_cell(None), by_cell(residual) / UNITS
    squares = by_cell(residual**2) / UNITS**2
    tables = number > 0.0, number, total, squares, total**2 / np.maximum(number, 1.0)
    return tuple(_sum_about_knots(table) for table in tables)


def _sum_about_knots(table: FloatArray | BoolArray) -> FloatArray:
    """Sum over the cells that touch each knot and those beside them, (M, n_bins + 1)."""
    cells = table.astype(np.float64)
    ring = np.pad(np.roll(cells, 1, 0) + cells + np.roll(cells, -1, 0), ((0, 0), (1, 1)))
    result: FloatArray = ring[:, :-1] + ring[:, 1:]
    return result


def _nearest(
    knots: FloatArray, seen: BoolArray, unseen: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Distance [m] of each knot of `unseen` to the nearest of `seen`, and which of them it is."""
    azimuth = 2.0 * np.pi * np.arange(len(seen))[:, None] / len(seen)
    places = np.stack([knots * np.cos(azimuth), knots * np.sin(azimuth)], axis=-1)
    distance, nearest = cKDTree(places[seen]).query(places[unseen])
    return distance, nearest
