"""Compiled twin of `gp_ground_seg.core.gp.ground`.

Row k of `whitened` is that of ``L^-1 K(inliers, candidates and knots)``. Adding an
inlier appends one row, after which means and variances everywhere follow by one
multiplication: a whole segment costs one factorisation. Inliers join from near to far,
mostly: columns nearer than the first candidate that is no inlier need no more rows.

The slope of the mean line is an unknown of its own (Rasmussen and Williams 2006, section 2.7), not
a part of the covariance, so that single precision is enough for that: ``slope_std^2 r r'`` would
be a thousand times the rest far away.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.compiled.numerics import LANES
from gp_ground_seg.core.frame import BoolArray, FloatArray, Frame, IntArray
from gp_ground_seg.core.gp.evidence import between_knots, combined, contradicts
from gp_ground_seg.core.gp.ground import fits, noise_among, noise_in_doubt, variances_of
from gp_ground_seg.core.gp.kernels import paciorek
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import GrowthConfig, ObservationConfig

ROUNDING = 1e-6
"""Least noise of what is observed, in parts of sigma_f^2: the rounding of single precision."""


class SegmentSurfaces(NamedTuple):
    """The surface of each segment by itself."""

    log_length_scale: FloatArray  # (C,) at the candidates [log m]
    # (M, K) at the knots [log m]; NaN from the first knot on that is not wanted
    knot_log_length_scale: FloatArray
    seed: BoolArray  # (C,) candidates that start the inlier set
    inlier: BoolArray  # (C,) candidates that the surface rests on
    # (M, K) height about the prior mean and its standard deviation at the knots [m]; NaN where
    # there is none
    mean: FloatArray
    std: FloatArray


class _Columns(NamedTuple):
    """State of the n candidates of a segment, and of the knots behind them; one column each."""

    r: FloatArray  # (size,) float32, ranges [m]
    length_scale: FloatArray  # (size,) float32 [m]
    # (size,) float32, prediction about the prior mean [m], and its variance [m^2], if the slope
    # is 0
    height: FloatArray
    variance: FloatArray
    lever: FloatArray  # (size,) float32, how much the prediction changes with the slope [m]
    slope: FloatArray  # (2,) what the inliers show of the slope: precision, and that times slope
    z: FloatArray  # (n,) heights of the candidates about the prior mean [m]
    noise: FloatArray  # (n,) variances of the noise with which they are observed [m^2]
    neighbour_height: FloatArray  # (n,) evidence at the candidates [m]
    neighbour_precision: FloatArray  # (n,) its precision [1/m^2]
    above: BoolArray  # (n,) candidates that the evidence contradicts
    new: IntArray  # (n,) candidates that join in this round
    whitened: FloatArray  # (n, size) float32, one row for each inlier


@jit()
def grow_surfaces(
    frame: Frame,
    theta: FloatArray,
    observation: ObservationConfig,
    growth: GrowthConfig,
    odds: float,
    from_neighbours: FloatArray,
    step: int,
    by_itself: SegmentSurfaces,
) -> None:
    """Inliers and surface of every `step`-th segment, into `by_itself`.

    `from_neighbours` (2, M, K) is the evidence of the segments beside each, (2, 0, 0) if there is
    none.
    Unless `odds` are 0, a candidate among others, or that joins in doubt, shows less: see
    `noise_among` and `noise_in_doubt`.
    """
    offsets, mean, std = frame.candidates.offsets, by_itself.mean, by_itself.std
    most = 0
    for m in range(0, len(mean), step):
        most = max(most, offsets[m + 1] - offsets[m])
    width = (most + len(frame.knots) + LANES - 1) & -LANES
    single, table = np.empty((5, width), np.float32), np.empty((4, most))
    # One by one, so that the compiler knows them to be contiguous.
    columns = _Columns(
        single[0],
        single[1],
        single[2],
        single[3],
        single[4],
        np.empty(2),
        table[0],
        table[1],
        table[2],
        table[3],
        np.zeros(most, np.bool_),
        np.empty(most, np.int64),
        np.empty((most, width), np.float32),
    )
    slope = observation.slope_std**2
    sill, noise = variances_of(theta)
    noise = max(noise, ROUNDING * sill)
    reach = math.exp(theta[3]) if odds > 0.0 else 0.0
    for m in range(0, len(mean), step):
        for j in range(len(frame.knots)):
            mean[m, j] = std[m, j] = np.nan
        n, n_new, has_neighbours = _begin(
            frame, m, noise, reach, from_neighbours, by_itself, columns
        )
        if n_new == 0 and not has_neighbours:
            continue
        n_knots = 0
        knot_u = by_itself.knot_log_length_scale[m]
        while n_knots < len(knot_u) and not math.isnan(knot_u[n_knots]):
            n_knots += 1
        size = (n + n_knots + LANES - 1) & -LANES
        _lay_out(frame, m, n_knots, size, sill, by_itself, columns)
        n_inliers = _grow(
            frame, m, size, n_new, sill, slope, noise, growth, odds, by_itself, columns
        )
        if n_inliers == 0:
            continue
        for j in range(n_knots):
            mean[m, j], variance = _predict(n + j, slope, columns)
            std[m, j] = math.sqrt(max(variance, 0.0))


@jit()
def _predict(j: int, slope: float, columns: _Columns) -> tuple[float, float]:
    """Height and variance at column `j`; `slope` is the prior variance of the slope."""
    variance = slope / (1.0 + slope * columns.slope[0])
    lever = np.float64(columns.lever[j])
    height = columns.height[j] + lever * variance * columns.slope[1]
    return height, columns.variance[j] + lever * lever * variance


@jit(part=True)
def _begin(
    frame: Frame,
    m: int,
    noise: float,
    reach: float,
    from_neighbours: FloatArray,
    by_itself: SegmentSurfaces,
    columns: _Columns,
) -> tuple[int, int, bool]:
    """Set heights of the candidates of segment `m`, evidence there, and seeds as the new ones.

    Returns how many candidates and how many seeds there are, and whether any evidence.
    """
    candidates, knots = frame.candidates, frame.knots
    first, stop = candidates.offsets[m], candidates.offsets[m + 1]
    n_new, has_neighbours = 0, False
    near = far = first
    for i in range(stop - first):
        c = first + i
        z, r = candidates.z[c] - frame.prior_mean, candidates.r[c]
        while r - candidates.r[near] > reach:
            near += 1
        while far < stop and candidates.r[far] - r <= reach:
            far += 1
        columns.z[i], columns.noise[i] = z, noise_among(far - near, noise)
        height = precision = 0.0
        if from_neighbours.shape[1] > 0:
            j = candidates.bin[c]
            heights, precisions = from_neighbours[0, m], from_neighbours[1, m]
            height = between_knots(r, knots[j], knots[j + 1], heights[j], heights[j + 1])
            precision = between_knots(r, knots[j], knots[j + 1], precisions[j], precisions[j + 1])
        columns.neighbour_height[i], columns.neighbour_precision[i] = height, precision
        columns.above[i] = contradicts(height, precision, z, noise)
        has_neighbours |= precision > 0.0
        by_itself.inlier[c] = False
        if by_itself.seed[c] and not columns.above[i]:
            columns.new[n_new] = i
            n_new += 1
    return stop - first, n_new, has_neighbours


@jit(part=True)
def _lay_out(
    frame: Frame,
    m: int,
    n_knots: int,
    size: int,
    sill: float,
    by_itself: SegmentSurfaces,
    columns: _Columns,
) -> None:
    """Set ranges and length-scales of candidates and knots, and their prior."""
    first = frame.candidates.offsets[m]
    n = frame.candidates.offsets[m + 1] - first
    r, length_scale, variance = columns.r, columns.length_scale, columns.variance
    # Element by element: assigned slices take as long, and seconds to compile.
    for i in range(n):
        r[i] = frame.candidates.r[first + i]
        length_scale[i] = by_itself.log_length_scale[first + i]
    for j in range(n_knots):
        r[n + j], length_scale[n + j] = frame.knots[j], by_itself.knot_log_length_scale[m, j]
    for j in range(n + n_knots, size):
        r[j] = length_scale[j] = 0.0
    for j in range(size):
        length_scale[j] = math.exp(length_scale[j])
        columns.height[j], variance[j], columns.lever[j] = 0.0, sill, r[j]
    columns.slope[:] = 0.0


@jit(part=True)
def _grow(
    frame: Frame,
    m: int,
    size: int,
    n_new: int,
    sill: float,
    slope: float,
    noise: float,
    growth: GrowthConfig,
    odds: float,
    by_itself: SegmentSurfaces,
    columns: _Columns,
) -> int:
    """Let the new ones join, and those that then fit, until none does; return the number."""
    first, stop = frame.candidates.offsets[m], frame.candidates.offsets[m + 1]
    inlier, in_face = by_itself.inlier[first:stop], frame.in_face[first:stop]
    continues_line = frame.continues_line[first:stop]
    n_inliers = done = 0
    for a in range(n_new):
        i = columns.new[a]
        if odds > 0.0 and in_face[i]:
            height, variance = combined(
                *_predict(i, slope, columns),
                columns.neighbour_height[i],
                columns.neighbour_precision[i],
            )
            columns.noise[i] = noise_in_doubt(
                columns.z[i], height, variance, columns.noise[i], True, odds
            )
    while n_new > 0 or n_inliers == 0:
        for a in range(n_new):
            i = columns.new[a]
            inlier[i] = True
            while done < len(inlier) and inlier[done]:
                done += 1
            # The columns before are not needed any more.
            _observe(i, n_inliers, min(i, done) & -LANES, size, sill, columns)
            n_inliers += 1
        n_new = 0
        for i in range(done, len(inlier)):
            precision = columns.neighbour_precision[i]
            # Before anything has joined, only the evidence of neighbours decides.
            if inlier[i] or (n_inliers == 0 and precision == 0.0):
                continue
            follows = i > 0 and inlier[i - 1] and continues_line[i] and not columns.above[i]
            if not follows:
                height, variance = combined(
                    *_predict(i, slope, columns), columns.neighbour_height[i], precision
                )
                follows = fits(columns.z[i], height, variance, noise, growth)
                if follows and odds > 0.0:
                    columns.noise[i] = noise_in_doubt(
                        columns.z[i], height, variance, columns.noise[i], in_face[i], odds
                    )
            if follows:
                columns.new[n_new] = i
                n_new += 1
        if n_new == 0:
            break
    return n_inliers


@jit(part=True)
def _observe(
    i: int,
    n_inliers: int,
    near: int,
    size: int,
    sill: float,
    columns: _Columns,
) -> None:
    """Condition the columns from `near` on on candidate i: one more row of `whitened`."""
    r, length_scale, whitened = columns.r, columns.length_scale, columns.whitened
    row, r_i, l_i, single_sill = whitened[n_inliers], r[i], length_scale[i], np.float32(sill)
    # Unsigned, as a signed index could count from the end.
    start, end = np.uintp(near), np.uintp(size)
    # Prior covariance of column i with the others (paper, eq. 8).
    for j in range(start, end):
        row[j] = paciorek(r_i, l_i, r[j], length_scale[j], single_sill)
    # Subtract the projection on the rows before, four rows at a time, so that the
    # new row is read and written once for all of them.
    k = 0
    while k + 4 <= n_inliers:
        row_0, row_1 = whitened[k], whitened[k + 1]
        row_2, row_3 = whitened[k + 2], whitened[k + 3]
        w_0, w_1, w_2, w_3 = row_0[i], row_1[i], row_2[i], row_3[i]
        for j in range(start, end):
            row[j] -= w_0 * row_0[j] + w_1 * row_1[j] + w_2 * row_2[j] + w_3 * row_3[j]
        k += 4
    while k < n_inliers:
        row_0, w_0 = whitened[k], whitened[k, i]
        for j in range(start, end):
            row[j] -= w_0 * row_0[j]
        k += 1
    height, variance, lever = columns.height, columns.variance, columns.lever
    precision = 1.0 / (max(variance[i], 0.0) + columns.noise[i])
    missed, lever_i = columns.z[i] - height[i], np.float64(lever[i])
    columns.slope[0] += lever_i * lever_i * precision
    columns.slope[1] += lever_i * missed * precision
    scale = np.float32(math.sqrt(precision))
    innovation, turn = np.float32(missed) * scale, np.float32(lever_i) * scale
    for j in range(start, end):
        value = row[j] * scale
        row[j] = value
        height[j] += value * innovation
        lever[j] -= value * turn
        variance[j] -= value * value
