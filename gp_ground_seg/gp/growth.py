"""Inlier growth and the surface of every segment.

Two implementations of one procedure: `grow_surface_reference` says it plainly,
`grow_surface_compiled` appends rows to a Cholesky factor and never factors anew.
They agree to rounding.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import compiled_vectors
from gp_ground_seg.config import GrowthConfig
from gp_ground_seg.gp.decay import decay
from gp_ground_seg.gp.observation import posterior
from gp_ground_seg.polar_grid import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]


def grow_surface_reference(
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    length_scale: FloatArray,
    seed: BoolArray,
    follows: BoolArray,
    knots: FloatArray,
    knot_length_scale: FloatArray,
    sigma_f: FloatArray,
    sigma_n: FloatArray,
    gate_noise: FloatArray,
    slope_std: float,
    growth: GrowthConfig,
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Grow the inliers of each segment from its seeds and predict the surface.

    A candidate joins when the predictive standard deviation is at most
    ``growth.max_std`` and its standardised residual is at most
    ``growth.max_standardised_residual`` above the prediction, or
    ``growth.max_standardised_depth`` below; repeated until none joins (GP-INSAC of
    Chen et al. 2014; the paper's outlier rejection). The gate is lopsided because
    obstacles lie only above the ground.

    Parameters
    ----------
    offsets : (M + 1,) int64
        Candidates of segment m are ``offsets[m]:offsets[m + 1]``.
    r, z, length_scale : (C,) float64
        Range, height about the prior mean, and length-scale of the candidates [m].
    seed : (C,) bool
        Candidates that start the inlier set.
    follows : (C,) bool
        Candidates that join if the one before them has: they continue its line.
    knots : (K,) float64
        Ranges where the surface is wanted [m].
    knot_length_scale : (M, K) float64
        Length-scale there [m]; NaN from the first knot on that is not wanted.
    sigma_f, sigma_n : (M,) float64
        Standard deviations of process and noise in each segment [m].
    gate_noise : (M,) float64
        Standard deviation of the noise that the residuals are standardised with [m].
    slope_std : float
        Prior standard deviation of the mean line's slope.
    growth : GrowthConfig
        Bounds for joining.

    Returns
    -------
    inlier : (C,) bool
        Candidates that made the surface.
    mean, std : (M, K) float64
        Height about the prior mean and its standard deviation [m]; NaN at knots that
        are not wanted and in segments without an inlier.
    """
    n_segments = len(offsets) - 1
    inlier = seed.copy()
    mean = np.full((n_segments, len(knots)), np.nan)
    std = np.full((n_segments, len(knots)), np.nan)
    for m in range(n_segments):
        own = slice(offsets[m], offsets[m + 1])
        r_own, z_own, l_own, chosen = r[own], z[own], length_scale[own], inlier[own]
        if not chosen.any():
            continue
        while True:
            height, variance = posterior(
                r_own[chosen],
                z_own[chosen],
                l_own[chosen],
                r_own,
                l_own,
                sigma_f[m],
                sigma_n[m],
                slope_std,
            )
            residual = (z_own - height) / np.sqrt(variance + gate_noise[m] ** 2)
            joining = (
                ~chosen
                & (variance <= growth.max_std**2)
                & (residual <= growth.max_standardised_residual)
                & (residual >= -growth.max_standardised_depth)
            )
            following = follows[own].copy()
            following[1:] &= chosen[:-1]
            joining |= following & ~chosen
            if not joining.any():
                break
            chosen |= joining
        wanted = np.isfinite(knot_length_scale[m])
        mean[m, wanted], variance = posterior(
            r_own[chosen],
            z_own[chosen],
            l_own[chosen],
            knots[wanted],
            knot_length_scale[m, wanted],
            sigma_f[m],
            sigma_n[m],
            slope_std,
        )
        std[m, wanted] = np.sqrt(variance)
    return inlier, mean, std


@compiled_vectors
def grow_surface_compiled(
    start: int,
    stop: int,
    step: int,
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    length_scale: FloatArray,
    seed: BoolArray,
    follows: BoolArray,
    knots: FloatArray,
    knot_length_scale: FloatArray,
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
    """Do what `grow_surface_reference` does for segments ``start:stop:step``, in place.

    ``whitened[k]`` is row k of ``L^-1 K(inliers, candidates and knots)``. Adding
    an inlier appends one row, after which means and variances everywhere follow
    by one multiplication: a whole segment costs one factorisation. Inliers come
    from near to far, mostly: what lies nearer than the first candidate that is none
    needs no more rows.
    """
    for m in range(start, stop, step):
        first = offsets[m]
        n = offsets[m + 1] - first
        joining = seed[first : first + n].copy()
        if not joining.any():
            continue
        n_knots = 0
        while n_knots < len(knots) and not math.isnan(knot_length_scale[m, n_knots]):
            n_knots += 1
        all_r = np.empty(n + n_knots)
        all_l = np.empty(n + n_knots)
        all_r[:n] = r[first : first + n]
        all_r[n:] = knots[:n_knots]
        all_l[:n] = length_scale[first : first + n]
        all_l[n:] = knot_length_scale[m, :n_knots]
        square = all_l * all_l
        whitened = np.empty((n, n + n_knots))
        height = np.zeros(n + n_knots)
        variance = sigma_f[m] ** 2 + slope_std**2 * all_r**2
        n_inliers = 0
        done = 0
        end = np.uintp(n + n_knots)
        grown = True
        while grown:
            for i in range(n):
                if not joining[i]:
                    continue
                inlier[first + i] = True
                while done < n and inlier[first + done]:
                    done += 1
                # Nothing asks for the columns before; unsigned, or they could count from the end.
                near = np.uintp(min(i, done))
                row = whitened[n_inliers]
                own_r, own_l, own_square = all_r[i], all_l[i], square[i]
                tilt = slope_std**2 * own_r
                for j in range(near, end):
                    inverse = 1.0 / (own_square + square[j])
                    distance = own_r - all_r[j]
                    root = math.sqrt(2.0 * own_l * all_l[j] * inverse)
                    kernel = sigma_f[m] ** 2 * root * decay(distance * distance * inverse)
                    row[j] = kernel + tilt * all_r[j]
                # Four rows at a time: the new row is read and written once for all of them.
                k = 0
                while k + 4 <= n_inliers:
                    row_0, row_1 = whitened[k], whitened[k + 1]
                    row_2, row_3 = whitened[k + 2], whitened[k + 3]
                    w_0, w_1, w_2, w_3 = row_0[i], row_1[i], row_2[i], row_3[i]
                    for j in range(near, end):
                        taken = w_0 * row_0[j] + w_1 * row_1[j] + w_2 * row_2[j] + w_3 * row_3[j]
                        row[j] -= taken
                    k += 4
                while k < n_inliers:
                    row_0 = whitened[k]
                    w_0 = row_0[i]
                    for j in range(near, end):
                        row[j] -= w_0 * row_0[j]
                    k += 1
                scale = 1.0 / math.sqrt(variance[i] + sigma_n[m] ** 2)
                innovation = (z[first + i] - height[i]) * scale
                for j in range(near, end):
                    value = row[j] * scale
                    row[j] = value
                    height[j] += value * innovation
                    variance[j] -= value * value
                n_inliers += 1
            grown = False
            for i in range(n):
                if follows[first + i] and inlier[first + i - 1] and not inlier[first + i]:
                    joining[i] = grown = True
                    continue
                spread = math.sqrt(max(variance[i], 0.0) + gate_noise[m] ** 2)
                residual = (z[first + i] - height[i]) / spread
                joining[i] = (
                    not inlier[first + i]
                    and variance[i] <= max_std**2
                    and -max_standardised_depth <= residual <= max_standardised_residual
                )
                grown = grown or joining[i]
        for j in range(n_knots):
            mean[m, j] = height[n + j]
            std[m, j] = math.sqrt(max(variance[n + j], 0.0))
