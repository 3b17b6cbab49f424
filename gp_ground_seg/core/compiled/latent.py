"""Compiled twin of `gp_ground_seg.core.gp.latent`: the mean of the latent process."""

import math

import numpy as np

from gp_ground_seg.core.compiled.numerics import LANES, solve_in_place
from gp_ground_seg.core.frame import FloatArray, Frame
from gp_ground_seg.core.gp import latent
from gp_ground_seg.core.gp.kernels import squared_exponential
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.jit import compiled_form, jit


@compiled_form(latent.latent_log_length_scales)
def latent_log_length_scales(
    frame: Frame,
    theta: FloatArray,
    step: int,
    log_length_scale: FloatArray,
    knot_log_length_scale: FloatArray,
) -> None:
    """Do what the twin does."""
    candidates, pseudo, knots = frame.candidates, frame.pseudo, frame.knots
    most = most_bar = 0
    for m in range(0, len(knot_log_length_scale), step):
        most = max(most, candidates.offsets[m + 1] - candidates.offsets[m])
        most_bar = max(most_bar, pseudo.offsets[m + 1] - pseudo.offsets[m])
    width = (most + len(knots) + LANES - 1) & -LANES
    wanted, value = np.empty(width, np.float32), np.empty(width, np.float32)
    bound = np.float32(MAX_ABS_LOG_LENGTH_SCALE)
    width = (most_bar + LANES - 1) & -LANES
    matrix, weight, centres = np.empty((most_bar, width)), np.empty(width), np.empty(width)
    variance = math.exp(2.0 * theta[2])
    single_sharpness = np.float32(0.5 * math.exp(-2.0 * theta[3]))
    for m in range(0, len(knot_log_length_scale), step):
        for j in range(len(knots)):
            knot_log_length_scale[m, j] = np.nan
        p, first = pseudo.offsets[m + 1] - pseudo.offsets[m], candidates.offsets[m]
        n = candidates.offsets[m + 1] - first
        if p == 0:
            continue
        # Behind the bin of the last candidate nothing is known of the ground.
        n_wanted = min(candidates.bin[first + n - 1] + 2, len(knots))
        mean = _weigh(frame, m, theta, matrix, weight, centres)
        # Element by element: assigned slices take as long, and seconds to compile.
        for i in range(n):
            wanted[i] = candidates.r[first + i]
        for i in range(n_wanted):
            wanted[n + i] = knots[i]
        size = (n + n_wanted + LANES - 1) & -LANES
        for i in range(n + n_wanted, size):
            wanted[i] = 0.0
        for i in range(size):
            value[i] = mean
        # Pseudo-inputs in the outer loop, so that the inner loop runs along a row.
        for j in range(p):
            centre, scaled = np.float32(centres[j]), np.float32(weight[j] * variance)
            for i in range(size):
                value[i] += squared_exponential(wanted[i], centre, scaled, single_sharpness)
        for i in range(size):
            value[i] = min(max(value[i], -bound), bound)
        for i in range(n):
            log_length_scale[first + i] = value[i]
        for i in range(n_wanted):
            knot_log_length_scale[m, i] = value[n + i]


@jit(part=True)
def _weigh(
    frame: Frame,
    m: int,
    theta: FloatArray,
    matrix: FloatArray,
    weight: FloatArray,
    centres: FloatArray,
) -> float:
    """Set the weights and places of the pseudo-inputs of segment `m`; return their mean."""
    pseudo = frame.pseudo
    first, p = pseudo.offsets[m], pseudo.offsets[m + 1] - pseudo.offsets[m]
    variance, noise = math.exp(2.0 * theta[2]), math.exp(2.0 * theta[4])
    sharpness = 0.5 * math.exp(-2.0 * theta[3])
    mean = 0.0
    for i in range(p):
        weight[i] = pseudo.log_extent[first + i] + theta[5 + pseudo.kind[first + i]]
        mean += weight[i] / p
    end = (p + LANES - 1) & -LANES
    for i in range(end):
        centres[i] = pseudo.r_bar[first + i] if i < p else 0.0
    for i in range(p):
        weight[i] -= mean
        row, centre = matrix[i], centres[i]
        for j in range(i & -LANES, end):
            row[j] = squared_exponential(centre, centres[j], variance, sharpness)
        row[i] += noise
    if not solve_in_place(matrix, p, weight):
        # Rounding exceeds the noise term: the mean is what remains.
        for i in range(p):
            weight[i] = 0.0
    return mean
