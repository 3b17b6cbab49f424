"""Compiled twin of `gp_ground_seg.core.gp.ground`.

Row k of `whitened` is that of ``L^-1 K(inliers, columns)``. Adding an inlier appends one row,
after which means and variances everywhere follow by one multiplication: a whole segment costs one
factorisation. Inliers join from near to far, mostly: columns nearer than the first candidate that
is no inlier need no more rows.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.compiled.numerics import LANES
from gp_ground_seg.core.frame import BoolArray, FloatArray, Frame, IntArray
from gp_ground_seg.core.gp import ground
from gp_ground_seg.core.gp.evidence import Evidence, between_knots, combined, contradicts
from gp_ground_seg.core.gp.kernels import (
    line_covariance,
    line_variances,
    paciorek,
)
from gp_ground_seg.core.gp.model import Model, SegmentSurfaces
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.parameters.config import ObservationConfig
from gp_ground_seg.core.pipeline.lines import is_walkable


class _Columns(NamedTuple):
    """State of the candidates of a segment, or of its inliers and the knots; one column each."""

    r: FloatArray  # (size,) ranges [m]
    length_scale: FloatArray  # (size,) float32 [m]
    height: FloatArray  # (size,) prediction about the prior mean [m]
    variance: FloatArray  # (size,) its variance [m^2]
    process: FloatArray  # (size,) float32 covariances of the process with the last inlier [m^2]
    z: FloatArray  # (n,) heights of the candidates about the prior mean [m]
    noise: FloatArray  # (n,) variances of the noise with which they are observed [m^2]
    neighbour_height: FloatArray  # (n,) evidence at the candidates [m]
    neighbour_precision: FloatArray  # (n,) its precision [1/m^2]
    above: BoolArray  # (n,) candidates that the evidence contradicts
    new: IntArray  # (n,) candidates that join in this round
    whitened: FloatArray  # (n, size) one row for each inlier
    squares: FloatArray  # (2,) number and sum of the squared innovations, of all segments


class _Prior(NamedTuple):
    """Prior of the heights of all segments."""

    sill: float  # variance of the process [m^2]
    slope: float  # variance of the slope of the mean line
    sixth: float  # a sixth of the variance that it gains over a metre [1/m]
    noise: float  # variance of the noise of a candidate by itself [m^2]


@jit(part=True)
def _prior_of(frame: Frame, theta: FloatArray, observation: ObservationConfig) -> _Prior:
    sill, noise = ground.variances_of(frame, theta, observation, ground.ROUNDING_SINGLE)
    slope, sixth = line_variances(observation)
    return _Prior(sill, slope, sixth, noise)


@jit(part=True)
def _make_columns(frame: Frame, step: int, n_knots: int, precision: Any) -> _Columns:
    """Room for any of every `step`-th segment, with `n_knots`, of type `precision`."""
    offsets, most = frame.candidates.offsets, 0
    for m in range(0, len(offsets) - 1, step):
        most = max(most, offsets[m + 1] - offsets[m])
    width = (most + n_knots + LANES - 1) & -LANES
    of_columns, table = np.empty((3, width), precision), np.empty((4, most))
    # One by one, so that the compiler knows them to be contiguous.
    return _Columns(
        of_columns[0],
        np.empty(width, np.float32),
        of_columns[1],
        of_columns[2],
        np.empty(width, np.float32),
        table[0],
        table[1],
        table[2],
        table[3],
        np.zeros(most, np.bool_),
        np.empty(most, np.int64),
        np.empty((most, width), precision),
        np.zeros(2),
    )


@compiled_form(ground.grow_inliers)
def grow_inliers(
    frame: Frame,
    theta: FloatArray,
    model: Model,
    from_neighbours: Evidence,
    step: int,
    found: SegmentSurfaces,
) -> float:
    """Do what the twin does; the inliers of other segments are arbitrary."""
    columns = _make_columns(frame, step, 0, np.float32)
    prior = _prior_of(frame, theta, model.observation)
    reach = math.exp(theta[3]) if model.by_roughness else 0.0
    for m in range(0, len(frame.candidates.offsets) - 1, step):
        n_seeds = _begin(frame, m, prior.noise, reach, from_neighbours, found, columns)
        _grow(frame, m, n_seeds, prior, model, found, columns)
    return columns.squares[1] / columns.squares[0] if columns.squares[0] > 0.0 else 1.0


@compiled_form(ground.regress)
def regress(
    frame: Frame,
    theta: FloatArray,
    observation: ObservationConfig,
    step: int,
    found: SegmentSurfaces,
) -> None:
    """Do what the twin does."""
    knots, candidates = frame.knots, frame.candidates
    # What is learned may be a noise of millimetres, which single precision would not resolve.
    columns = _make_columns(frame, step, len(knots), np.float64)
    prior = _prior_of(frame, theta, observation)
    r, length_scale = columns.r, columns.length_scale
    for m in range(0, len(found.mean), step):
        mean, std, knot_u = found.mean[m], found.std[m], found.knot_log_length_scale[m]
        mean[:] = std[:] = np.nan
        n = n_knots = 0
        for c in range(candidates.offsets[m], candidates.offsets[m + 1]):
            if found.inlier[c]:
                r[n], length_scale[n] = candidates.r[c], found.log_length_scale[c]
                columns.z[n] = candidates.z[c] - frame.prior_mean
                columns.noise[n] = ground.noise_among(found.alike[c], prior.noise) + found.doubt[c]
                n += 1
        if n == 0:
            continue
        while n_knots < len(knots) and not math.isnan(knot_u[n_knots]):
            r[n + n_knots], length_scale[n + n_knots] = knots[n_knots], knot_u[n_knots]
            n_knots += 1
        size = _lay_out(n + n_knots, prior, columns)
        for i in range(n):
            _observe(i, i, i & -LANES, size, prior, columns)
        for j in range(n_knots):
            mean[j] = columns.height[n + j]
            std[j] = math.sqrt(max(columns.variance[n + j], 0.0))


@jit(part=True)
def _lay_out(n: int, prior: _Prior, columns: _Columns) -> int:
    """Set the prior of `n` columns; return their number in whole vectors.

    Their log length-scales become length-scales.
    """
    size, r, length_scale = (n + LANES - 1) & -LANES, columns.r, columns.length_scale
    r[n:size] = length_scale[n:size] = 0.0
    for j in range(size):
        length_scale[j] = math.exp(length_scale[j])
        columns.height[j] = 0.0
        columns.variance[j] = prior.sill + line_covariance(r[j], r[j], prior.slope, prior.sixth)
    return size


@jit(part=True)
def _begin(
    frame: Frame,
    m: int,
    noise: float,
    reach: float,
    from_neighbours: Evidence,
    found: SegmentSurfaces,
    columns: _Columns,
) -> int:
    """Set heights of the candidates of segment `m`, evidence there, and seeds as the new ones.

    Returns how many seeds there are.
    """
    candidates, knots = frame.candidates, frame.knots
    first, stop = candidates.offsets[m], candidates.offsets[m + 1]
    n_new, near, far = 0, first, first
    for i in range(stop - first):
        c = first + i
        z, r = candidates.z[c] - frame.prior_mean, candidates.r[c]
        while r - candidates.r[near] > reach:
            near += 1
        while far < stop and candidates.r[far] - r <= reach:
            far += 1
        found.alike[c] = far - near
        columns.z[i], columns.noise[i] = z, ground.noise_among(far - near, noise)
        height = precision = 0.0
        if len(from_neighbours.height) > 0:
            j = candidates.bin[c]
            heights, precisions = from_neighbours.height[m], from_neighbours.precision[m]
            height = between_knots(r, knots[j], knots[j + 1], heights[j], heights[j + 1])
            precision = between_knots(r, knots[j], knots[j + 1], precisions[j], precisions[j + 1])
        columns.neighbour_height[i], columns.neighbour_precision[i] = height, precision
        above = contradicts(height, precision, z, noise)
        columns.above[i] = above and not frame.land[c]
        found.inlier[c] = False
        if found.seed[c] and not columns.above[i]:
            columns.new[n_new] = i
            n_new += 1
    return n_new


@jit(part=True)
def _grow(
    frame: Frame,
    m: int,
    n_new: int,
    prior: _Prior,
    model: Model,
    found: SegmentSurfaces,
    columns: _Columns,
) -> None:
    """Let the new ones join, and those that then fit, until none does."""
    first = frame.candidates.offsets[m]
    n = frame.candidates.offsets[m + 1] - first
    for i in range(n):
        columns.r[i] = frame.candidates.r[first + i]
        columns.length_scale[i] = found.log_length_scale[first + i]
    size = _lay_out(n, prior, columns)
    for a in range(n_new):
        i = columns.new[a]
        if model.by_roughness and frame.in_face[first + i]:
            height, variance = _predict(i, columns)
            columns.noise[i] = ground.noise_in_doubt(
                columns.z[i], height, variance, columns.noise[i], True
            )
    n_inliers = done = 0
    while n_new > 0 or n_inliers == 0:
        for a in range(n_new):
            i = columns.new[a]
            found.inlier[first + i] = True
            while done < n and found.inlier[first + done]:
                done += 1
            # The columns before are not needed any more.
            _observe(i, n_inliers, min(i, done) & -LANES, size, prior, columns)
            n_inliers += 1
        n_new = _find_joining(
            frame, m, found.inlier, done, n_inliers > 0, prior.noise, model, columns
        )
        if n_new == 0:
            break
    found.doubt[first : first + n] = columns.noise[:n] - ground.noise_among(
        found.alike[first : first + n], prior.noise
    )


@jit(part=True)
def _find_joining(
    frame: Frame,
    m: int,
    inlier: BoolArray,
    done: int,
    has_inliers: bool,
    noise: float,
    model: Model,
    columns: _Columns,
) -> int:
    """Set the new ones to those from `done` on that now join; return their number."""
    first, growth, n_new, last = frame.candidates.offsets[m], model.growth, 0, done - 1
    for i in range(done, frame.candidates.offsets[m + 1] - first):
        c, in_face, z = first + i, frame.in_face[first + i], columns.z[i]
        if inlier[c]:
            last = i
            continue
        # Before anything has joined, only the evidence of neighbours decides.
        if not has_inliers and columns.neighbour_precision[i] == 0.0:
            continue
        height, variance = _predict(i, columns)
        joins, falls, is_shown = ground.fits(z, height, variance, noise, growth), False, False
        if last >= 0:
            rise = z - columns.z[last]
            distance = frame.candidates.r[c] - frame.candidates.r[first + last]
            walkable = is_walkable(rise, distance, growth.max_slope)
            if walkable and not in_face and not columns.above[i]:
                is_shown = ground.carries_on(rise, distance, frame.onward[c], frame.land[c])
                falls = rise <= 0.0
            elif not joins:
                last = -1  # it stands on the ground, which does not go on behind it
        if joins and model.by_roughness and not is_shown:
            columns.noise[i] = ground.noise_in_doubt(
                z, height, variance, columns.noise[i], in_face
            )
        if joins or is_shown or falls:
            columns.new[n_new] = i
            n_new += 1
    return n_new


@jit(part=True)
def _predict(i: int, columns: _Columns) -> tuple[float, float]:
    """Height and variance at candidate i, with the evidence of neighbours."""
    height, variance = np.float64(columns.height[i]), np.float64(columns.variance[i])
    return combined(height, variance, columns.neighbour_height[i], columns.neighbour_precision[i])


@jit(part=True)
def _observe(
    i: int, n_inliers: int, near: int, size: int, prior: _Prior, columns: _Columns
) -> None:
    """Condition the columns from `near` on on candidate i: one more row of `whitened`."""
    # Arrays are taken from `columns` each time: references to those with a name are counted.
    r_i, l_i = columns.r[i], columns.length_scale[i]
    sill, zero, number = np.float32(prior.sill), np.float32(0.0), columns.r.dtype.type
    slope, sixth = number(prior.slope), number(prior.sixth)
    # Unsigned indices: see `numerics`.
    start, end, own, n = np.uintp(near), np.uintp(size), np.uintp(i), np.uintp(n_inliers)
    one, two, three, four = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)
    # Prior covariance of column i with the others (paper, eq. 8): that of the process always is of
    # single precision, by differences of ranges in their own. A loop of one precision is faster.
    for j in range(start, end):
        columns.process[j] = r_i - columns.r[j]
    for j in range(start, end):
        columns.process[j] = paciorek(columns.process[j], l_i, zero, columns.length_scale[j], sill)
    for j in range(start, end):
        walked = line_covariance(r_i, columns.r[j], slope, sixth)
        columns.whitened[n, j] = columns.process[j] + walked
    # Subtract the projection on the rows before: the new one is read and written once for four.
    for k in range(np.uintp(0), n & ~three, four):
        w_0, w_1 = columns.whitened[k, own], columns.whitened[k + one, own]
        w_2, w_3 = columns.whitened[k + two, own], columns.whitened[k + three, own]
        for j in range(start, end):
            known = w_0 * columns.whitened[k, j] + w_1 * columns.whitened[k + one, j]
            known = known + w_2 * columns.whitened[k + two, j]
            columns.whitened[n, j] -= known + w_3 * columns.whitened[k + three, j]
    for k in range(n & ~three, n):
        w_0 = columns.whitened[k, own]
        for j in range(start, end):
            columns.whitened[n, j] -= w_0 * columns.whitened[k, j]
    precision = 1.0 / (max(columns.variance[i], 0.0) + columns.noise[i])
    scale = number(math.sqrt(precision))
    innovation = number(columns.z[i] - columns.height[i]) * scale
    columns.squares[0] += 1.0
    columns.squares[1] += innovation * innovation
    for j in range(start, end):
        value = columns.whitened[n, j] * scale
        columns.whitened[n, j] = value
        columns.height[j] += value * innovation
        columns.variance[j] -= value * value
