"""Whole-frame objective and its gradient, plainly.

The compiled twin is `gp_ground_seg.compiled.objective_compiled`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError

from gp_ground_seg.frame import FloatArray, IntArray
from gp_ground_seg.gp import dense
from gp_ground_seg.gp.kernels import paciorek, squared_exponential

N_SCALARS = 5
"""Entries of theta before the log length-scales of the surface classes."""


@dataclass(frozen=True)
class TrainingFrame:
    """Inliers and pseudo-inputs of all segments, what the hyper-parameters are learned from.

    Attributes
    ----------
    offsets : (M + 1,) int64
        Inliers of segment m are ``offsets[m]:offsets[m + 1]``.
    r, z : (n,) float64
        Their ranges and heights about the prior mean [m].
    log_length_scale : (n,) float64
        Their log length-scales where no latent process gives them [log m].
    bar_offsets : (M + 1,) int64
        Pseudo-inputs of segment m; all zero without a latent process.
    r_bar : (p,) float64
        Ranges of the pseudo-inputs [m].
    surface_class : (p,) int64
        Surface class of each pseudo-input.
    """

    offsets: IntArray
    r: FloatArray
    z: FloatArray
    log_length_scale: FloatArray
    bar_offsets: IntArray
    r_bar: FloatArray
    surface_class: IntArray

    @property
    def n_segments(self) -> int:
        """Number of segments."""
        return len(self.offsets) - 1


def objective_reference(
    theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
) -> tuple[float, FloatArray]:
    """Log marginal likelihood of a frame and its gradient (paper, eqs. 19 and 20).

    Parameters
    ----------
    theta : (5 + K,) float64
        Logarithms of sigma_f, sigma_n [m], sigma_f_bar [log m], sigma_l_bar [m],
        sigma_n_bar [log m], then the log length-scale of each of K surface classes.
    frame : TrainingFrame
        Inliers and pseudo-inputs.
    slope_std : float
        Prior standard deviation of the mean line's slope.
    latent_terms : bool
        Whether the terms of the latent process, ``-1/2 log|B_m|``, are in: with
        them the objective is the printed one, which has no upper bound.

    Returns
    -------
    value : float
        Log marginal likelihood; ``-inf`` where a covariance is not positive definite.
    gradient : (5 + K,) float64
        Its gradient in `theta`.
    """
    value, gradient = 0.0, np.zeros(len(theta))
    for m in range(frame.n_segments):
        own = slice(frame.offsets[m], frame.offsets[m + 1])
        bar = slice(frame.bar_offsets[m], frame.bar_offsets[m + 1])
        if own.start == own.stop:
            continue
        try:
            value += _segment(
                theta,
                gradient,
                frame.r[own],
                frame.z[own],
                frame.log_length_scale[own],
                frame.r_bar[bar],
                frame.surface_class[bar],
                slope_std,
                latent_terms,
            )
        except LinAlgError:
            return -np.inf, np.zeros(len(theta))
    return value, gradient


def _segment(
    theta: FloatArray,
    gradient: FloatArray,
    r: FloatArray,
    z: FloatArray,
    u: FloatArray,
    r_bar: FloatArray,
    surface_class: IntArray,
    slope_std: float,
    latent_terms: bool,
) -> float:
    """Value of one segment; adds to `gradient`. Letters are those of the paper."""
    sigma_f, sigma_n, sigma_f_bar, sigma_l_bar, sigma_n_bar = np.exp(theta[:N_SCALARS])
    latent = len(r_bar) > 0
    if latent:
        l_bar = theta[N_SCALARS + surface_class]
        k_bar = squared_exponential(r_bar, r_bar, sigma_f_bar, sigma_l_bar)
        b_factor = dense.factorise(k_bar + sigma_n_bar**2 * np.eye(len(r_bar)))
        beta = dense.solve(b_factor, l_bar - l_bar.mean())
        k_star = squared_exponential(r, r_bar, sigma_f_bar, sigma_l_bar)
        u = l_bar.mean() + k_star @ beta

    length_scale = np.exp(u)
    k = paciorek(r, length_scale, r, length_scale, sigma_f)
    a_factor = dense.factorise(k + slope_std**2 * np.outer(r, r) + sigma_n**2 * np.eye(len(r)))
    alpha = dense.solve(a_factor, z)
    value = -0.5 * float(
        z @ alpha + dense.log_determinant(a_factor) + len(r) * np.log(2.0 * np.pi)
    )

    g = 0.5 * (np.outer(alpha, alpha) - dense.inverse(a_factor))
    gradient[0] += np.sum(g * 2.0 * k)
    gradient[1] += 2.0 * sigma_n**2 * np.trace(g)
    if not latent:
        return value

    square = length_scale**2
    spread = square[:, None] + square[None, :]
    distance2 = (r[:, None] - r[None, :]) ** 2
    dlog_k = 0.5 - square[:, None] / spread + 2.0 * square[:, None] * distance2 / spread**2
    g_u = 2.0 * np.sum(g * k * dlog_k, axis=1)

    weight = dense.solve(b_factor, k_star.T @ g_u)
    g_l_bar = weight + (g_u.sum() - weight.sum()) / len(r_bar)
    np.add.at(gradient, N_SCALARS + surface_class, g_l_bar)

    bar_distance2 = (r_bar[:, None] - r_bar[None, :]) ** 2
    star_distance2 = (r[:, None] - r_bar[None, :]) ** 2
    derivatives = (
        (2.0 * k_star, 2.0 * k_bar),
        (k_star * star_distance2 / sigma_l_bar**2, k_bar * bar_distance2 / sigma_l_bar**2),
        (np.zeros_like(k_star), 2.0 * sigma_n_bar**2 * np.eye(len(r_bar))),
    )
    for q, (dk_star, db) in enumerate(derivatives):
        gradient[2 + q] += g_u @ dk_star @ beta - weight @ db @ beta
        if latent_terms:
            gradient[2 + q] -= 0.5 * np.trace(dense.solve(b_factor, db))
    if latent_terms:
        value -= 0.5 * (dense.log_determinant(b_factor) + len(r_bar) * np.log(2.0 * np.pi))
    return value
