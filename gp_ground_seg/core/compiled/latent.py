"""Compiled twin of `gp_ground_seg.core.gp.latent`: the mean of the latent process."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.compiled.numerics import LANES, exp_neg, solve_in_place
from gp_ground_seg.core.compiled.threads import Part
from gp_ground_seg.core.frame import FloatArray, Frame
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.jit import jit


@jit(entry=True)
def latent_log_length_scales(
    part: Part,
    frame: Frame,
    theta: FloatArray,
    at_candidates: FloatArray,
    at_knots: FloatArray,
) -> None:
    """Do what the twin does for the segments of a part, into the last two arrays."""
    pseudo, knots = frame.pseudo, frame.knots
    candidates = frame.candidates
    offsets, r = candidates.offsets, candidates.r
    most = most_bar = 0
    for m in range(part.number, len(at_knots), part.n_parts):
        most = max(most, offsets[m + 1] - offsets[m])
        most_bar = max(most_bar, pseudo.offsets[m + 1] - pseudo.offsets[m])
    room = (most + len(knots) + LANES - 1) & -LANES
    wanted, value = np.empty(room), np.empty(room)
    room = (most_bar + LANES - 1) & -LANES
    matrix, weight, centres = np.empty((most_bar, room)), np.empty(room), np.empty(room)
    for m in range(part.number, len(at_knots), part.n_parts):
        for j in range(len(knots)):
            at_knots[m, j] = np.nan
        first, own = pseudo.offsets[m], offsets[m]
        p, n = pseudo.offsets[m + 1] - first, offsets[m + 1] - own
        if p == 0:
            continue
        # Behind the bin of the last candidate nothing is known of the ground.
        n_wanted = min(candidates.bin[own + n - 1] + 2, len(knots))
        variance = math.exp(2.0 * theta[m, 2])
        sharpness = 0.5 * math.exp(-2.0 * theta[m, 3])
        noise = math.exp(2.0 * theta[m, 4])
        mean = 0.0
        for i in range(p):
            mean += pseudo.log_extent[first + i] / p
        end = (p + LANES - 1) & -LANES
        for i in range(end):
            centres[i] = pseudo.r_bar[first + i] if i < p else 0.0
        for i in range(p):
            weight[i] = pseudo.log_extent[first + i] - mean
            row = matrix[i]
            for j in range(i & -LANES, end):
                d = centres[i] - centres[j]
                row[j] = variance * exp_neg(sharpness * d * d)
            row[i] += noise
        if not solve_in_place(matrix, p, weight):
            # Rounding exceeds the noise term: the mean is what remains.
            for i in range(p):
                weight[i] = 0.0
        # Pseudo-inputs in the outer loop, so that the inner loop runs along a row.
        size = (n + n_wanted + LANES - 1) & -LANES
        # Element by element: assigned slices take as long, and seconds to compile.
        for i in range(n):
            wanted[i] = r[own + i]
        for i in range(n_wanted):
            wanted[n + i] = knots[i]
        for i in range(n + n_wanted, size):
            wanted[i] = 0.0
        for i in range(size):
            value[i] = mean + theta[m, 5]
        for j in range(p):
            scaled = weight[j] * variance
            centre = centres[j]
            for i in range(size):
                d = wanted[i] - centre
                value[i] += scaled * exp_neg(sharpness * d * d)
        for i in range(size):
            value[i] = min(max(value[i], -MAX_ABS_LOG_LENGTH_SCALE), MAX_ABS_LOG_LENGTH_SCALE)
        for i in range(n):
            at_candidates[own + i] = value[i]
        for i in range(n_wanted):
            at_knots[m, i] = value[n + i]
