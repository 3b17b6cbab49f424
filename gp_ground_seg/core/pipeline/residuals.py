"""Bias and uncertainty of the surface, by the returns called ground.

The process is fitted to the lowest point of each bin, so it lies below the mean of the returns,
and its standard deviation follows from its hyper-parameters. The returns tell both. About each
knot they lie in up to six cells: the two of its segment that meet there, and theirs of the
segments beside it. With ``n_i`` returns of mean residual ``e_i`` in cell i, n in all, the mean of
the residuals is ``e = sum n_i e_i / n``, and by the law of total variance their variance is::

    sum n_i (e_i - e)^2 / n  +  sum n_i Var_i / n,

that between the cells and that within them. The first is how far the ground departs from the
corrected surface from cell to cell; the second is range noise, and roughness finer than a cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from gp_ground_seg.core.frame import (
    BoolArray,
    FloatArray,
    GroundSurface,
    Label,
    Labelled,
    PolarGrid,
)

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

    One cell does not show how ground varies from cell to cell: where the window has no other, the
    standard deviations are those of the process.

    A knot is seen if one of the two cells that touch it has returns. The height at any other is
    estimated twice: by the process, and by the nearest knot that is seen, whose variance grows by
    ``(slope_std distance)^2``, the prior of the slope. The two are weighted by their inverse
    variances. The result is as uncertain as evidence so far away, or as the process where that is
    more, plus the variance between the two.

    `noise_std`, (M, 1), is that of the process in each segment [m], `slope_std` the prior standard
    deviation of the ground's slope.
    """
    has_model = np.isfinite(surface.mean)
    is_touched, (n_cells, n_returns, total, squares, squared_means) = _sums(labelled, grid)
    seen, unseen = is_touched & has_model, ~is_touched & has_model
    number = np.maximum(n_returns, 1.0)
    correction = np.where(seen, total / number, np.where(has_model, 0.0, np.nan))

    alone, tells = surface.std**2, seen & (n_cells >= 2.0)
    between = np.maximum(squared_means / number - correction**2, 0.0)
    variance = np.where(tells, between, alone)
    noise = np.where(tells, np.maximum(squares - squared_means, 0.0) / number, noise_std**2)
    if seen.any() and unseen.any():
        distance, nearest = _nearest(surface.knots, seen, unseen)
        alone, apart = alone[unseen], (slope_std * distance) ** 2
        for table in (correction, variance, noise):
            table[unseen] = table[seen][nearest]
        near_mean = surface.mean[seen][nearest]
        difference = near_mean - surface.mean[unseen]
        weight = alone / np.maximum(alone + variance[unseen] + apart, np.finfo(float).tiny)
        correction[unseen] += weight * difference
        variance[unseen] = np.maximum(variance[unseen], alone) + apart
        variance[unseen] += weight * (1.0 - weight) * difference**2
    mean, std = surface.mean + correction, np.sqrt(variance)
    return CorrectedSurface(surface.knots, correction, mean, std, np.sqrt(variance + noise))


def _sums(labelled: Labelled, grid: PolarGrid) -> tuple[BoolArray, tuple[FloatArray, ...]]:
    """Which knots are touched by a cell with returns called ground, and sums about them, (M, K).

    The sums are over six cells: cells with such returns, their number, the sum of their residuals
    [m], of the squares [m^2], and over the cells of number times squared mean [m^2].
    """
    is_ground = (labelled.label == Label.GROUND) & grid.inside
    cell, residual = grid.cell[is_ground], np.rint(labelled.height[is_ground] * UNITS)
    shape = grid.n_segments, grid.n_bins

    def by_cell(weights: FloatArray | None) -> FloatArray:
        return np.bincount(cell, weights, shape[0] * shape[1]).reshape(shape).astype(np.float64)

    number, total = by_cell(None), by_cell(residual) / UNITS
    squares = by_cell(residual**2) / UNITS**2
    occupied = (number > 0.0).astype(np.float64)
    tables = occupied, number, total, squares, total**2 / np.maximum(number, 1.0)
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
    """Distance [m] of each knot of `unseen` to the nearest of `seen`, and which of them it is."""
    azimuth = 2.0 * np.pi * np.arange(len(seen))[:, None] / len(seen)
    places = np.stack([knots * np.cos(azimuth), knots * np.sin(azimuth)], axis=-1)
    distance, nearest = cKDTree(places[seen]).query(places[unseen])
    return distance, nearest
