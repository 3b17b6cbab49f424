"""The estimated ground of a frame, and its value under any point."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.frame import FloatArray, IntArray
from gp_ground_seg.jit import inlined


def fuse_neighbours(
    mean: FloatArray, std: FloatArray, knots: FloatArray, n_neighbours: int, slope_std: float
) -> tuple[FloatArray, FloatArray]:
    """Fuse each segment's surface with those of its neighbours.

    The surface of the segment k steps aside predicts this one with the variance
    ``std^2 + (slope_std s_k)^2``, where ``s_k`` is the arc between the two at the
    knot's range: the same prior slope as along the range. The predictions are
    weighted by their inverse variances. A segment without a model gets one from
    its neighbours, if they have any.

    Parameters
    ----------
    mean, std : (M, K) float64
        Height and standard deviation at the knots [m]; NaN from the first knot on
        where there is no model.
    knots : (K,) float64
        Ranges of the knots [m].
    n_neighbours : int
        Segments on either side.
    slope_std : float
        Standard deviation of the ground's slope.

    Returns
    -------
    mean, std : (M, K) float64
        Fused height and standard deviation [m].
    """
    if n_neighbours == 0:
        return mean, std
    step = 2.0 * np.pi / len(mean)
    total_weight = np.zeros_like(mean)
    weighted = np.zeros_like(mean)
    for k in range(-n_neighbours, n_neighbours + 1):
        variance = np.roll(std, k, axis=0) ** 2 + (slope_std * abs(k) * step * knots) ** 2
        known = np.isfinite(variance)
        # A surface that is certain to a tenth of a millimetre is as certain as any.
        weight = np.where(known, 1.0 / np.maximum(np.where(known, variance, 1.0), 1e-8), 0.0)
        total_weight += weight
        weighted += weight * np.where(known, np.roll(mean, k, axis=0), 0.0)
    known = total_weight > 0.0
    safe = np.where(known, total_weight, 1.0)
    return np.where(known, weighted / safe, np.nan), np.where(known, 1.0 / np.sqrt(safe), np.nan)


@inlined
def fuse_rows(
    start: int,
    stop: int,
    mean: FloatArray,
    std: FloatArray,
    n_known: IntArray,
    knots: FloatArray,
    n_neighbours: int,
    slope_std: float,
    prior_mean: float,
    fused_mean: FloatArray,
    fused_std: FloatArray,
) -> None:
    """Do what `fuse_neighbours` does for segments `start` to `stop`, in place.

    `n_known` (M,) are the knots up to which a segment has a model; `mean` is about
    `prior_mean`, and the result is not.
    """
    n_segments, n_knots = mean.shape
    aside = slope_std * 2.0 * math.pi / n_segments
    total_weight, weighted = np.empty(n_knots), np.empty(n_knots)
    for m in range(start, stop):
        if n_neighbours == 0:
            for j in range(n_knots):
                fused_mean[m, j], fused_std[m, j] = mean[m, j] + prior_mean, std[m, j]
            continue
        for j in range(n_knots):
            total_weight[j] = weighted[j] = 0.0
        n_fused = 0
        for k in range(-n_neighbours, n_neighbours + 1):
            other = (m - k) % n_segments
            n_fused = max(n_fused, n_known[other])
            slope = k * aside
            their_mean, their_std = mean[other], std[other]
            for j in range(n_known[other]):
                away = slope * knots[j]
                weight = 1.0 / max(their_std[j] * their_std[j] + away * away, 1e-8)
                total_weight[j] += weight
                weighted[j] += weight * their_mean[j]
        for j in range(n_fused):
            fused_mean[m, j] = weighted[j] / total_weight[j] + prior_mean
            fused_std[m, j] = 1.0 / math.sqrt(total_weight[j])
        for j in range(n_fused, n_knots):
            fused_mean[m, j] = fused_std[m, j] = math.nan
