"""Log marginal likelihood of a whole frame and its gradient, segment by segment.

Compiled code has loops in place of all but `log_likelihood`.
"""

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray, Inliers, IntArray
from gp_ground_seg.core.gp.kernels import (
    inverted,
    line_covariance,
    line_variances,
    paciorek,
    squared_exponential,
)
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.jit import shared
from gp_ground_seg.core.parameters.config import ObservationConfig

LOG_2PI = math.log(2.0 * math.pi)


@shared
def log_likelihood(
    theta: FloatArray, inliers: Inliers, observation: ObservationConfig, latent_terms: bool
) -> tuple[float, FloatArray]:
    """Log marginal likelihood of a frame and its gradient (paper, eqs. 19 and 20).

    `theta`, (T,), holds the logarithms of sigma_f, sigma_n [m], sigma_f_bar [log m],
    sigma_l_bar [m], sigma_n_bar [log m], and of the factors on the length-scales of the lines.
    `observation` has the prior of the mean line: it is marginalised, which adds `line_covariance`
    to the kernel (Rasmussen and Williams 2006, section 2.7). With `latent_terms` the terms of the
    latent process, ``-1/2 log|B_m|``, are in: the objective is the printed one, which has no upper
    bound.

    Returns the value, ``-inf`` where a covariance is not positive definite, and its gradient in
    `theta`, (T,).
    """
    value, gradient = 0.0, np.zeros(len(theta))
    for m in np.flatnonzero(np.diff(inliers.offsets)):
        own = slice(inliers.offsets[m], inliers.offsets[m + 1])
        bar = slice(inliers.bar_offsets[m], inliers.bar_offsets[m + 1])
        r, z, u = inliers.r[own], inliers.z[own], inliers.log_length_scale[own]
        if bar.start == bar.stop:
            value += observe(theta, gradient, r, z, u, observation)[0]
        else:
            bars = inliers.r_bar[bar], inliers.log_extent[bar], inliers.kind[bar]
            latent = predict(theta, *bars, r)
            own_value, g = observe(theta, gradient, r, z, latent.u, observation)
            value += own_value + add_latent(theta, gradient, latent, r, g, latent_terms)
    if not math.isfinite(value):
        return -math.inf, np.zeros(len(theta))
    return value, gradient


def observe(
    theta: FloatArray,
    gradient: FloatArray,
    r: FloatArray,
    z: FloatArray,
    u: FloatArray,
    observation: ObservationConfig,
) -> tuple[float, FloatArray]:
    """Value of the heights (n,) at ranges (n,) with log length-scales (n,).

    Adds to `gradient`, and returns the derivatives of the value in log k too, (n, n).
    """
    sigma_f, sigma_n = np.exp(theta[:2])
    length_scale = np.exp(u)
    k = paciorek(r[:, None], length_scale[:, None], r, length_scale, sigma_f**2)
    covariance = k + line_covariance(r[:, None], r, *line_variances(observation))
    covariance += sigma_n**2 * np.eye(len(r))
    inverse, log_root = inverted(covariance)
    alpha = inverse @ z
    value = -0.5 * float(z @ alpha + len(r) * LOG_2PI) - log_root
    # G = (alpha alpha^T - A^-1) / 2 is the derivative of the value in A.
    g: FloatArray = 0.5 * (np.outer(alpha, alpha) - inverse)
    gradient[1] += 2.0 * sigma_n**2 * np.trace(g)
    g *= k
    gradient[0] += 2.0 * g.sum()
    return value, g


class Latent(NamedTuple):
    """Latent process of a segment with p pseudo-inputs at the ranges of its n inliers."""

    u: FloatArray  # (n,) log length-scale
    r_bar: FloatArray  # (p,) ranges of the pseudo-inputs [m]
    kind: IntArray  # (p,) entry of L-bar of each
    k_bar: FloatArray  # (p, p) without noise
    k_star: FloatArray  # (n, p)
    inverse: FloatArray  # (p, p) of B
    log_root: float  # half the logarithm of its determinant
    beta: FloatArray  # (p,)


def predict(
    theta: FloatArray, r_bar: FloatArray, log_extent: FloatArray, kind: IntArray, r: FloatArray
) -> Latent:
    """Latent process with these pseudo-inputs (p,), at ranges `r` (n,)."""
    kernel = np.exp(2.0 * theta[2]), 0.5 * np.exp(-2.0 * theta[3])
    l_bar = log_extent + theta[5 + kind]
    k_bar = squared_exponential(r_bar[:, None], r_bar, *kernel)
    k_star = squared_exponential(r[:, None], r_bar, *kernel)
    inverse, log_root = inverted(k_bar + np.exp(2.0 * theta[4]) * np.eye(len(r_bar)))
    beta = inverse @ (l_bar - l_bar.mean())
    u, bound = l_bar.mean() + k_star @ beta, MAX_ABS_LOG_LENGTH_SCALE
    return Latent(np.clip(u, -bound, bound), r_bar, kind, k_bar, k_star, inverse, log_root, beta)


def add_latent(
    theta: FloatArray,
    gradient: FloatArray,
    latent: Latent,
    r: FloatArray,
    g: FloatArray,
    latent_terms: bool,
) -> float:
    """Propagate the derivatives in log k, `g` (n, n), to theta; return the latent terms.

    dk/du_i = k (1/2 - l_i^2 / s (1 - 2 d^2 / s)), s = l_i^2 + l_j^2, in rows and columns.
    """
    square, beta, r_bar = np.exp(2.0 * latent.u), latent.beta, latent.r_bar
    spread, distance = square[:, None] + square, r[:, None] - r
    along = 1.0 - 2.0 * square[:, None] / spread * (1.0 - 2.0 * distance**2 / spread)
    is_free = np.abs(latent.u) < MAX_ABS_LOG_LENGTH_SCALE
    g_u = is_free * (g * along).sum(axis=1)
    # u is the mean of L-bar and what the process makes of the differences from it.
    weight = latent.inverse @ (g_u @ latent.k_star)
    g_l_bar = weight + (g_u.sum() - weight.sum()) / len(beta)
    gradient[5:] += np.bincount(latent.kind, g_l_bar, len(gradient) - 5)
    # Adjoints of k_star and of B: every derivative is contracted with them.
    star, adjoint = g_u[:, None] * latent.k_star * beta, -np.outer(weight, beta)
    if latent_terms:
        adjoint -= 0.5 * latent.inverse
    gradient[4] += 2.0 * np.exp(2.0 * theta[4]) * np.trace(adjoint)
    adjoint *= latent.k_bar
    gradient[2] += 2.0 * (star.sum() + adjoint.sum())
    contracted = (star * (r[:, None] - r_bar) ** 2).sum()
    contracted += (adjoint * (r_bar[:, None] - r_bar) ** 2).sum()
    gradient[3] += contracted * np.exp(-2.0 * theta[3])
    return -(latent.log_root + 0.5 * len(beta) * LOG_2PI) if latent_terms else 0.0
