"""Compiled twin of `gp_ground_seg.core.gp.ground`.

Row k of `whitened` is that of ``L^-1 K(inliers, candidates and knots)``. Adding an
inlier appends one row, after which means and variances everywhere follow by one
multiplication: a whole segment costs one factorisation. Inliers join from near to far,
mostly: columns nearer than the first candidate that is no inlier need no more rows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.compiled.numerics import LANES, exp_neg
from gp_ground_seg.core.compiled.threads import Part
from gp_ground_seg.core.frame import BoolArray, FloatArray, Frame
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import GrowthConfig, ObservationConfig


class SegmentSurfaces(NamedTuple):
    """The surface of each segment by itself.

    Attributes
    ----------
    log_length_scale : (C,) float64
        At the candidates [log m].
    knot_log_length_scale : (M, K) float64
        At the knots [log m]; NaN from the first knot on that is not wanted.
    seed : (C,) bool
        Candidates that start the inlier set.
    inlier : (C,) bool
        Candidates that the surface rests on.
    mean, std : (M, K) float64
        Height about the prior mean and its standard deviation at the knots [m]; NaN where there
        is none.
    """

    log_length_scale: FloatArray
    knot_log_length_scale: FloatArray
    seed: BoolArray
    inlier: BoolArray
    mean: FloatArray
    std: FloatArray


@jit(entry=True)
def grow_surfaces(
    part: Part,
    frame: Frame,
    theta: FloatArray,
    observation: ObservationConfig,
    growth: GrowthConfig,
    aside: FloatArray,
    step: int,
    own: SegmentSurfaces,
) -> None:
    """Inliers and surface of one of `step` segments of a part, into `own`.

    `aside` (2, M, K) is the evidence of the segments beside each, (2, 0, 0) if there is none.
    """
    candidates, knots = frame.candidates, frame.knots
    offsets, r = candidates.offsets, candidates.r
    inlier, mean, std = own.inlier, own.mean, own.std
    looks_aside = aside.shape[1] > 0
    most = 0
    for m in range(part.number * step, len(mean), part.n_parts * step):
        most = max(most, offsets[m + 1] - offsets[m])
    room = (most + len(knots) + LANES - 1) & -LANES
    columns, whitened = np.empty((8, room)), np.empty((most, room))
    # One by one, so that the compiler knows them to be contiguous.
    all_r, all_l, square = columns[0], columns[1], columns[2]
    predicted, variance, observed = columns[3], columns[4], columns[5]
    aside_height, aside_precision = columns[6], columns[7]
    above = np.zeros(most, np.bool_)
    new = np.empty(most, np.int64)
    slope = observation.slope_std**2
    for m in range(part.number * step, len(mean), part.n_parts * step):
        first = offsets[m]
        n = offsets[m + 1] - first
        sigma_n = math.exp(theta[m, 1])
        sill, noise = math.exp(theta[m, 0]) ** 2, sigma_n**2
        for j in range(len(knots)):
            mean[m, j] = std[m, j] = np.nan
        n_new, has_aside = 0, False
        for i in range(n):
            observed[i] = candidates.z[first + i] - frame.prior_mean
            if not looks_aside:
                aside_height[i] = aside_precision[i] = 0.0
                continue
            j = candidates.bin[first + i]
            share = (r[first + i] - knots[j]) / (knots[j + 1] - knots[j])
            share = min(max(share, 0.0), 1.0)
            height, precision = aside[0, m], aside[1, m]
            aside_height[i] = height[j] + share * (height[j + 1] - height[j])
            weight = precision[j] + share * (precision[j + 1] - precision[j])
            aside_precision[i] = weight
            has_aside |= weight > 0.0
            spread = math.sqrt(1.0 / weight + noise)
            residual = observed[i] - aside_height[i]
            above[i] = weight > 0.0 and residual > growth.max_standardised_residual * spread
        for i in range(n):
            inlier[first + i] = False
            if own.seed[first + i] and not above[i]:
                new[n_new] = i
                n_new += 1
        if n_new == 0 and not has_aside:
            continue
        n_knots = 0
        while n_knots < len(knots) and not math.isnan(own.knot_log_length_scale[m, n_knots]):
            n_knots += 1
        size = (n + n_knots + LANES - 1) & -LANES
        # Element by element: assigned slices take as long, and seconds to compile.
        for i in range(n):
            all_r[i], all_l[i] = r[first + i], own.log_length_scale[first + i]
        for j in range(n_knots):
            all_r[n + j], all_l[n + j] = knots[j], own.knot_log_length_scale[m, j]
        for j in range(n + n_knots, size):
            all_r[j] = all_l[j] = 0.0
        for j in range(size):
            all_l[j] = exp_neg(-all_l[j])
            square[j] = all_l[j] * all_l[j]
            predicted[j] = 0.0
            variance[j] = sill + slope * all_r[j] * all_r[j]
        n_inliers = done = 0
        # Unsigned, as a signed index could count from the end.
        end = np.uintp(size)
        while True:
            for a in range(n_new):
                i = new[a]
                inlier[first + i] = True
                while done < n and inlier[first + done]:
                    done += 1
                # The columns before are not needed any more.
                near = np.uintp(min(i, done) & -LANES)
                row = whitened[n_inliers]
                own_r, own_l, own_square = all_r[i], 2.0 * all_l[i], square[i]
                # Prior covariance of column i with the columns from `near` on (paper, eq. 8).
                for j in range(near, end):
                    inverse = 1.0 / (own_square + square[j])
                    distance = own_r - all_r[j]
                    root = math.sqrt(own_l * all_l[j] * inverse)
                    value = sill * root * exp_neg(distance * distance * inverse)
                    row[j] = value + slope * own_r * all_r[j]
                # Subtract the projection on the rows before, four rows at a time, so that the
                # new row is read and written once for all of them.
                k = 0
                while k + 4 <= n_inliers:
                    row_0, row_1 = whitened[k], whitened[k + 1]
                    row_2, row_3 = whitened[k + 2], whitened[k + 3]
                    w_0, w_1, w_2, w_3 = row_0[i], row_1[i], row_2[i], row_3[i]
                    for j in range(near, end):
                        row[j] -= w_0 * row_0[j] + w_1 * row_1[j] + w_2 * row_2[j] + w_3 * row_3[j]
                    k += 4
                while k < n_inliers:
                    row_0, w_0 = whitened[k], whitened[k, i]
                    for j in range(near, end):
                        row[j] -= w_0 * row_0[j]
                    k += 1
                scale = 1.0 / math.sqrt(variance[i] + noise)
                innovation = (observed[i] - predicted[i]) * scale
                for j in range(near, end):
                    value = row[j] * scale
                    row[j] = value
                    predicted[j] += value * innovation
                    variance[j] -= value * value
                n_inliers += 1
            n_new = 0
            for i in range(done, n):
                if inlier[first + i]:
                    continue
                follows = i > 0 and inlier[first + i - 1] and frame.continues_line[first + i]
                # Before anything has joined, only evidence from aside decides.
                if n_inliers == 0 and aside_precision[i] == 0.0:
                    continue
                if (follows and not above[i]) or fits(
                    observed[i],
                    predicted[i],
                    variance[i],
                    aside_height[i],
                    aside_precision[i],
                    noise,
                    growth,
                ):
                    new[n_new] = i
                    n_new += 1
            if n_new == 0:
                break
        if n_inliers == 0:
            continue
        for j in range(n_knots):
            mean[m, j] = predicted[n + j]
            std[m, j] = math.sqrt(max(variance[n + j], 0.0))


@jit()
def fits(
    z: float,
    height: float,
    variance: float,
    aside_height: float,
    aside_precision: float,
    noise: float,
    growth: GrowthConfig,
) -> bool:
    """Whether a candidate is predicted well enough, and near enough, to join."""
    if aside_precision > 0.0:
        variance = max(variance, 0.0)
        own_share = 1.0 / (1.0 + variance * aside_precision)
        height = own_share * height + (1.0 - own_share) * aside_height
        variance *= own_share
    residual = z - height
    limit = growth.max_standardised_depth
    if residual > 0.0:
        limit = growth.max_standardised_residual
    spread = max(variance, 0.0) + noise
    return variance <= growth.max_std**2 and residual * residual <= limit * limit * spread
