"""Latent process GP_l: log length-scale over range in one segment."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.compiled.decay import decay
from gp_ground_seg.frame import FloatArray, IntArray
from gp_ground_seg.gp import dense
from gp_ground_seg.gp.kernels import squared_exponential
from gp_ground_seg.jit import inlined

LANES = 4
"""Columns that vector instructions take at once: rows end at multiples of it, as what is left
over at the end takes longer than all before."""


def log_length_scale(
    r_bar: FloatArray,
    log_length_scale_bar: FloatArray,
    r_star: FloatArray,
    sigma_f_bar: float,
    sigma_l_bar: float,
    sigma_n_bar: float,
) -> FloatArray:
    """Mean of the latent process at `r_star` (paper, eqs. 10 and 11).

    The values are centred on their mean, so that equal pseudo-inputs give that
    very value everywhere.

    Parameters
    ----------
    r_bar, log_length_scale_bar : (p,) float64
        Pseudo-inputs: ranges [m] and log length-scales [log m].
    r_star : (k,) float64
        Ranges wanted [m].
    sigma_f_bar, sigma_n_bar : float
        Standard deviations of the process and of its noise [log m].
    sigma_l_bar : float
        Length-scale of the process [m].

    Returns
    -------
    (k,) float64
        Log length-scales [log m].
    """
    mean = log_length_scale_bar.mean()
    covariance = squared_exponential(r_bar, r_bar, sigma_f_bar, sigma_l_bar)
    covariance[np.diag_indices_from(covariance)] += sigma_n_bar**2
    weight = dense.solve(dense.factorise(covariance), log_length_scale_bar - mean)
    value: FloatArray = (
        mean + squared_exponential(r_star, r_bar, sigma_f_bar, sigma_l_bar) @ weight
    )
    return value


def latent_rows_reference(
    theta: FloatArray,
    bar_offsets: IntArray,
    r_bar: FloatArray,
    surface_class: IntArray,
    offsets: IntArray,
    r: FloatArray,
    knots: FloatArray,
    n_knots: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Log length-scales at the candidates and knots of every segment.

    Parameters
    ----------
    theta : (M, 5 + K) float64
        Hyper-parameters of each segment (see `gp_ground_seg.gp.objective`).
    bar_offsets, r_bar, surface_class
        Pseudo-inputs (see `gp_ground_seg.pipeline.pseudo_inputs.PseudoInputs`).
    offsets : (M + 1,) int64
        Candidates of segment m are ``offsets[m]:offsets[m + 1]``.
    r : (C,) float64
        Ranges of the candidates [m].
    knots : (K,) float64
        Ranges wanted [m].
    n_knots : (M,) int64
        How many of them, from the first on, are wanted in each segment.

    Returns
    -------
    at_candidates : (C,) float64
        Log length-scales [log m].
    at_knots : (M, K) float64
        The same at the knots; NaN at those that are not wanted.
    """
    n_segments = len(offsets) - 1
    at_candidates = np.empty(len(r))
    at_knots = np.full((n_segments, len(knots)), np.nan)
    for m in range(n_segments):
        own = slice(offsets[m], offsets[m + 1])
        bar = slice(bar_offsets[m], bar_offsets[m + 1])
        if own.start == own.stop:
            continue
        values = log_length_scale(
            r_bar[bar],
            theta[m, 5 + surface_class[bar]],
            np.concatenate([r[own], knots[: n_knots[m]]]),
            *np.exp(theta[m, 2:5]),
        )
        at_candidates[own] = values[: own.stop - own.start]
        at_knots[m, : n_knots[m]] = values[own.stop - own.start :]
    return at_candidates, at_knots


@inlined
def _eliminate(matrix: FloatArray, n: int, vector: FloatArray) -> bool:
    """Replace `vector` by the solution of ``A x = vector``; False if A is not positive definite.

    `matrix` holds the upper triangle of A, in rows of whole vectors. What is on the left of
    the diagonal, and behind column n, is of no account.
    """
    end = (n + LANES - 1) & -LANES
    for k in range(n):
        row = matrix[k]
        # Written so that NaN fails too.
        if not row[k] > 0.0:
            return False
        inverse = 1.0 / row[k]
        for i in range(k + 1, n):
            factor = row[i] * inverse
            below = matrix[i]
            for j in range(i & -LANES, end):
                below[j] -= factor * row[j]
            vector[i] -= factor * vector[k]
        row[k] = inverse
    for k in range(n - 1, -1, -1):
        row = matrix[k]
        value = vector[k]
        for j in range(k + 1, n):
            value -= row[j] * vector[j]
        vector[k] = value * row[k]
    return True


@inlined
def latent_rows_compiled(
    start: int,
    stop: int,
    theta: FloatArray,
    bar_offsets: IntArray,
    r_bar: FloatArray,
    surface_class: IntArray,
    offsets: IntArray,
    r: FloatArray,
    knots: FloatArray,
    n_knots: IntArray,
    at_candidates: FloatArray,
    at_knots: FloatArray,
) -> None:
    """Do what `latent_rows_reference` does for segments `start` to `stop`, in place."""
    most = most_bar = 0
    for m in range(start, stop):
        most = max(most, offsets[m + 1] - offsets[m])
        most_bar = max(most_bar, bar_offsets[m + 1] - bar_offsets[m])
    room = (most + len(knots) + LANES - 1) & -LANES
    wanted, value = np.empty(room), np.empty(room)
    room = (most_bar + LANES - 1) & -LANES
    matrix, weight, centres = np.empty((most_bar, room)), np.empty(room), np.empty(room)
    for m in range(start, stop):
        for j in range(len(knots)):
            at_knots[m, j] = np.nan
        first, own = bar_offsets[m], offsets[m]
        p, n, n_wanted = bar_offsets[m + 1] - first, offsets[m + 1] - own, n_knots[m]
        if p == 0:
            continue
        variance = math.exp(2.0 * theta[m, 2])
        sharpness = 0.5 * math.exp(-2.0 * theta[m, 3])
        noise = math.exp(2.0 * theta[m, 4])
        mean = 0.0
        for i in range(p):
            mean += theta[m, 5 + surface_class[first + i]] / p
        end = (p + LANES - 1) & -LANES
        for i in range(end):
            centres[i] = r_bar[first + i] if i < p else 0.0
        for i in range(p):
            weight[i] = theta[m, 5 + surface_class[first + i]] - mean
            row = matrix[i]
            for j in range(i & -LANES, end):
                d = centres[i] - centres[j]
                row[j] = variance * decay(sharpness * d * d)
            row[i] += noise
        if not _eliminate(matrix, p, weight):
            # Rounding beat the noise term: the mean is what is left to say.
            for i in range(p):
                weight[i] = 0.0
        # From pseudo-input to pseudo-input: the inner loop runs along a row.
        size = (n + n_wanted + LANES - 1) & -LANES
        # Element by element: to assign slices takes no less time, and seconds to compile.
        for i in range(n):
            wanted[i] = r[own + i]
        for i in range(n_wanted):
            wanted[n + i] = knots[i]
        for i in range(n + n_wanted, size):
            wanted[i] = 0.0
        for i in range(size):
            value[i] = mean
        for j in range(p):
            scaled = weight[j] * variance
            centre = centres[j]
            for i in range(size):
                d = wanted[i] - centre
                value[i] += scaled * decay(sharpness * d * d)
        for i in range(n):
            at_candidates[own + i] = value[i]
        for i in range(n_wanted):
            at_knots[m, i] = value[n + i]
