"""Inlier growth and the surface of every segment, compiled.

Row k of `whitened` is that of ``L^-1 K(inliers, candidates and knots)``. Adding an
inlier appends one row, after which means and variances everywhere follow by one
multiplication: a whole segment costs one factorisation. Inliers come from near to far,
mostly: what lies nearer than the first candidate that is none needs no more rows.
"""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.compiled.decay import decay
from gp_ground_seg.compiled.meeting import Board, all_done, claim, enlist
from gp_ground_seg.frame import BoolArray, FloatArray, IntArray
from gp_ground_seg.gp.latent import LANES, latent_rows_compiled
from gp_ground_seg.jit import compiled_vectors, inlined
from gp_ground_seg.pipeline.surface import fuse_rows

BLOCK = 3
"""Segments that a thread takes at a time."""
N_STAGES = 2
"""Stages of `estimate_surface`."""


@inlined
def grow_surface_compiled(
    start: int,
    stop: int,
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    log_length_scale: FloatArray,
    seed: BoolArray,
    follows: BoolArray,
    knots: FloatArray,
    knot_log_length_scale: FloatArray,
    sigma_f: FloatArray,
    sigma_n: FloatArray,
    gate_noise: FloatArray,
    slope_std: float,
    max_std: float,
    max_standardised_residual: float,
    max_standardised_depth: float,
    inlier: BoolArray,
    mean: FloatArray,
    std: FloatArray,
) -> None:
    """Do what `grow_surface_reference` does for segments `start` to `stop`, in place.

    Of the length-scales the logarithms.
    """
    most = 0
    for m in range(start, stop):
        most = max(most, offsets[m + 1] - offsets[m])
    room = (most + len(knots) + LANES - 1) & -LANES
    columns, whitened = np.empty((5, room)), np.empty((most, room))
    # Unpacked at once they would not be known to be contiguous.
    all_r, all_l, square = columns[0], columns[1], columns[2]
    height, variance = columns[3], columns[4]
    new = np.empty(most, np.int64)
    slope = slope_std**2
    for m in range(start, stop):
        first = offsets[m]
        n = offsets[m + 1] - first
        for j in range(len(knots)):
            mean[m, j] = std[m, j] = np.nan
        n_new = 0
        for i in range(n):
            inlier[first + i] = False
            if seed[first + i]:
                new[n_new] = i
                n_new += 1
        if n_new == 0:
            continue
        n_knots = 0
        while n_knots < len(knots) and not math.isnan(knot_log_length_scale[m, n_knots]):
            n_knots += 1
        size = (n + n_knots + LANES - 1) & -LANES
        # Element by element: to assign slices takes no less time, and seconds to compile.
        for i in range(n):
            all_r[i], all_l[i] = r[first + i], log_length_scale[first + i]
        for j in range(n_knots):
            all_r[n + j], all_l[n + j] = knots[j], knot_log_length_scale[m, j]
        for j in range(n + n_knots, size):
            all_r[j] = all_l[j] = 0.0
        sill = sigma_f[m] ** 2
        for j in range(size):
            all_l[j] = decay(-all_l[j])
            square[j] = all_l[j] * all_l[j]
            height[j] = 0.0
            variance[j] = sill + slope * all_r[j] * all_r[j]
        noise, gate = sigma_n[m] ** 2, gate_noise[m] ** 2
        n_inliers = done = 0
        # Unsigned, or columns could count from the end.
        end = np.uintp(size)
        while n_new > 0:
            a = 0
            while a < n_new:
                # Two at a time: the rows before are read once for both.
                i, ii = new[a], new[min(a + 1, n_new - 1)]
                inlier[first + i] = inlier[first + ii] = True
                while done < n and inlier[first + done]:
                    done += 1
                # Nothing asks for the columns before.
                near = np.uintp(min(i, done) & -LANES)
                row = whitened[n_inliers]
                _covariances(i, near, end, all_r, all_l, square, sill, slope, row)
                scale = 1.0 / math.sqrt(variance[i] + noise)
                innovation = (z[first + i] - height[i]) * scale
                if i == ii:
                    _project(whitened, n_inliers, i, near, end, row)
                    for j in range(near, end):
                        value = row[j] * scale
                        row[j] = value
                        height[j] += value * innovation
                        variance[j] -= value * value
                    n_inliers += 1
                    break
                after = whitened[n_inliers + 1]
                _covariances(ii, near, end, all_r, all_l, square, sill, slope, after)
                _project_two(whitened, n_inliers, i, ii, near, end, row, after)
                between = row[ii] * scale
                left = variance[ii] - between * between
                scale_2 = 1.0 / math.sqrt(left + noise)
                innovation_2 = (z[first + ii] - height[ii] - between * innovation) * scale_2
                for j in range(near, end):
                    value = row[j] * scale
                    value_2 = (after[j] - between * value) * scale_2
                    row[j] = value
                    after[j] = value_2
                    height[j] += value * innovation + value_2 * innovation_2
                    variance[j] -= value * value + value_2 * value_2
                n_inliers += 2
                a += 2
            n_new = 0
            for i in range(done, n):
                if inlier[first + i]:
                    continue
                residual = z[first + i] - height[i]
                limit = max_standardised_residual if residual > 0.0 else max_standardised_depth
                spread = max(variance[i], 0.0) + gate
                if (follows[first + i] and inlier[first + i - 1]) or (
                    variance[i] <= max_std**2 and residual * residual <= limit * limit * spread
                ):
                    new[n_new] = i
                    n_new += 1
        for j in range(n_knots):
            mean[m, j] = height[n + j]
            std[m, j] = math.sqrt(max(variance[n + j], 0.0))


@inlined
def _covariances(
    i: int,
    near: int,
    end: int,
    all_r: FloatArray,
    all_l: FloatArray,
    square: FloatArray,
    sill: float,
    slope: float,
    row: FloatArray,
) -> None:
    """Prior covariance of column `i` with the columns from `near` on (paper, eq. 8)."""
    own_r, own_l, own_square = all_r[i], 2.0 * all_l[i], square[i]
    tilt = slope * own_r
    for j in range(near, end):
        inverse = 1.0 / (own_square + square[j])
        distance = own_r - all_r[j]
        root = math.sqrt(own_l * all_l[j] * inverse)
        row[j] = sill * root * decay(distance * distance * inverse) + tilt * all_r[j]


@inlined
def _project(
    whitened: FloatArray, n_rows: int, i: int, near: int, end: int, row: FloatArray
) -> None:
    """Take out of a new row what the rows before hold of it."""
    # Four rows at a time: the new row is read and written once for all of them.
    k = 0
    while k + 4 <= n_rows:
        row_0, row_1, row_2, row_3 = whitened[k], whitened[k + 1], whitened[k + 2], whitened[k + 3]
        w_0, w_1, w_2, w_3 = row_0[i], row_1[i], row_2[i], row_3[i]
        for j in range(near, end):
            row[j] -= w_0 * row_0[j] + w_1 * row_1[j] + w_2 * row_2[j] + w_3 * row_3[j]
        k += 4
    while k < n_rows:
        row_0 = whitened[k]
        w_0 = row_0[i]
        for j in range(near, end):
            row[j] -= w_0 * row_0[j]
        k += 1


@inlined
def _project_two(
    whitened: FloatArray,
    n_rows: int,
    i: int,
    ii: int,
    near: int,
    end: int,
    row: FloatArray,
    after: FloatArray,
) -> None:
    """Do what `_project` does with the rows of two columns."""
    k = 0
    while k + 4 <= n_rows:
        row_0, row_1, row_2, row_3 = whitened[k], whitened[k + 1], whitened[k + 2], whitened[k + 3]
        w_0, w_1, w_2, w_3 = row_0[i], row_1[i], row_2[i], row_3[i]
        v_0, v_1, v_2, v_3 = row_0[ii], row_1[ii], row_2[ii], row_3[ii]
        for j in range(near, end):
            x_0, x_1, x_2, x_3 = row_0[j], row_1[j], row_2[j], row_3[j]
            row[j] -= w_0 * x_0 + w_1 * x_1 + w_2 * x_2 + w_3 * x_3
            after[j] -= v_0 * x_0 + v_1 * x_1 + v_2 * x_2 + v_3 * x_3
        k += 4
    while k < n_rows:
        row_0 = whitened[k]
        w_0, v_0 = row_0[i], row_0[ii]
        for j in range(near, end):
            row[j] -= w_0 * row_0[j]
            after[j] -= v_0 * row_0[j]
        k += 1


@compiled_vectors
def estimate_surface(
    share: int,
    n_shares: int,
    board: Board,
    is_latent: bool,
    theta: FloatArray,
    bar_offsets: IntArray,
    r_bar: FloatArray,
    surface_class: IntArray,
    offsets: IntArray,
    own_bin: IntArray,
    r: FloatArray,
    z: FloatArray,
    prior_mean: float,
    log_length_scale: FloatArray,
    follows: BoolArray,
    knots: FloatArray,
    knot_log_length_scale: FloatArray,
    least_gate_noise: float,
    slope_std: float,
    seed_range: float,
    seed_height_tolerance: float,
    segment_step: int,
    max_std: float,
    max_standardised_residual: float,
    max_standardised_depth: float,
    n_neighbours: int,
    n_knots: IntArray,
    scales: FloatArray,
    height: FloatArray,
    is_seed: BoolArray,
    own_surface: FloatArray,
    inlier: BoolArray,
    mean: FloatArray,
    std: FloatArray,
) -> None:
    """Length-scales, inliers and surface of every segment; then fused with its neighbours.

    What `gp_ground_seg.gp.growth.GrowthTask` says, in two stages; see
    `gp_ground_seg.compiled.meeting`. Length-scales are given unless `is_latent`. `n_knots` (M,),
    `scales` (3, M), `height` (C,), `is_seed` (C,) and `own_surface` (2, M, K) are room to
    work in.
    """
    share = enlist(board, share, n_shares)
    if share < 0:
        return
    sigma_f, sigma_n, gate_noise = scales[0], scales[1], scales[2]
    own_mean, own_std = own_surface[0], own_surface[1]
    n_segments = len(mean)
    n_blocks = (n_segments + BLOCK - 1) // BLOCK
    stage = np.int64(0)
    block = claim(board, stage, share, n_shares, n_blocks)
    while block >= 0:
        start, stop = block * BLOCK, min((block + 1) * BLOCK, n_segments)
        for m in range(start, stop):
            first, behind = offsets[m], offsets[m + 1]
            n_knots[m] = min(own_bin[behind - 1] + 2, len(knots)) if behind > first else 0
            sigma_f[m], sigma_n[m] = math.exp(theta[m, 0]), math.exp(theta[m, 1])
            gate_noise[m] = max(sigma_n[m], least_gate_noise)
            for i in range(first, behind):
                height[i] = z[i] - prior_mean
                is_low = abs(height[i]) <= seed_height_tolerance
                is_seed[i] = is_low and r[i] <= seed_range and m % segment_step == 0
        if is_latent:
            latent_rows_compiled(
                start, stop, theta, bar_offsets, r_bar, surface_class, offsets, r, knots,
                n_knots, log_length_scale, knot_log_length_scale,
            )  # fmt: skip
        grow_surface_compiled(
            start, stop, offsets, r, height, log_length_scale, is_seed, follows, knots,
            knot_log_length_scale, sigma_f, sigma_n, gate_noise, slope_std, max_std,
            max_standardised_residual, max_standardised_depth, inlier, own_mean, own_std,
        )  # fmt: skip
        for m in range(start, stop):
            n_knots[m] = 0
            while n_knots[m] < len(knots) and not math.isnan(own_std[m, n_knots[m]]):
                n_knots[m] += 1
        block = claim(board, stage, share, n_shares, n_blocks)
    if all_done(board, stage, share, n_shares, n_blocks):
        stage += 1
        block = claim(board, stage, share, n_shares, n_blocks)
        while block >= 0:
            start, stop = block * BLOCK, min((block + 1) * BLOCK, n_segments)
            fuse_rows(
                start, stop, own_mean, own_std, n_knots, knots, n_neighbours, slope_std,
                prior_mean, mean, std,
            )  # fmt: skip
            block = claim(board, stage, share, n_shares, n_blocks)
        all_done(board, stage, share, n_shares, n_blocks)
