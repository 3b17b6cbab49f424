"""Log marginal likelihood of a whole frame and its gradient, segment by segment."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray, Inliers, IntArray
from gp_ground_seg.core.gp.kernels import (
    line_covariance,
    line_variances,
    paciorek,
    single_threaded_blas,
    squared_exponential,
)
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.parameters.config import ObservationConfig

_LOG_2PI = math.log(2.0 * math.pi)


@single_threaded_blas()
def log_likelihood(
    theta: FloatArray, inliers: Inliers, observation: ObservationConfig, latent_terms: bool
) -> tuple[float, FloatArray]:
    """Log marginal likelihood of a frame and its gradient (paper, eqs. 19 and 20).

    `theta`, (T,), holds the logarithms of sigma_f, sigma_n [m], sigma_f_bar [log m],
    sigma_l_bar [m], sigma_n_bar [log m], and of the factors on the length-scales of the lines.
    `observation` has the prior of the mean line: it is marginalised, which adds `line_covariance`
    to the kernel (Rasmussen and Williams 2006, section 2.7). With `latent_terms` the terms of the latent process,
    ``-1/2 log|B_m|``, are in: the objective is the printed one, which has no upper bound.

    Returns the value, ``-inf`` where a covariance is not positive definite, and its gradient in
    `theta`, (T,).
    """
    value, gradient = 0.0, np.zeros(len(theta))
    try:
        for m in np.flatnonzero(np.diff(inliers.offsets)).tolist():
            value += _add_segment(theta, gradient, inliers, m, observation, latent_terms)
    except np.linalg.LinAlgError:
        value = -math.inf
    if not math.isfinite(value):
        return -math.inf, np.zeros(len(theta))
    return value, gradient


def _add_segment(
    theta: FloatArray,
    gradient: FloatArray,
    inliers: Inliers,
    m: int,
    observation: ObservationConfig,
    latent_terms: bool,
) -> float:
    """Value of segment `m`; adds to `gradient`. Letters are those of the paper."""
    own = slice(inliers.offsets[m], inliers.offsets[m + 1])
    r, z, u = inliers.r[own], inliers.z[own], inliers.log_length_scale[own]
    has_latent = inliers.bar_offsets[m + 1] > inliers.bar_offsets[m]
    latent = _Latent.of(theta, inliers, m, r) if has_latent else None
    if latent is not None:
        u = latent.u

    sigma_f, sigma_n = np.exp(theta[:2])
    length_scale = np.exp(u)
    k = paciorek(r[:, None], length_scale[:, None], r, length_scale, sigma_f**2)
    covariance = k + line_covariance(r[:, None], r, *line_variances(observation))
    covariance += sigma_n**2 * np.eye(len(r))
    factor = np.linalg.cholesky(covariance)
    a_inverse = np.linalg.inv(covariance)
    alpha = a_inverse @ z
    log_determinant = 2.0 * np.log(np.diagonal(factor)).sum()
    value = -0.5 * float(z @ alpha + log_determinant + len(r) * _LOG_2PI)

    # G = (alpha alpha^T - A^-1) / 2 is the derivative of the value in A.
    g = 0.5 * (np.outer(alpha, alpha) - a_inverse)
    gradient[1] += 2.0 * sigma_n**2 * np.trace(g)
    g *= k
    row_sum = g.sum(axis=1)
    gradient[0] += 2.0 * row_sum.sum()
    if latent is None:
        return value
    is_free = np.abs(u) < MAX_ABS_LOG_LENGTH_SCALE
    g_u = np.where(is_free, row_sum - _curvature(g, r, length_scale), 0.0)
    return value + latent.add_gradient(gradient, g_u, latent_terms)


def _curvature(g: FloatArray, r: FloatArray, length_scale: FloatArray) -> FloatArray:
    """Part of the derivative in u that depends on the distances; `g` is that in log k.

    dk/du_i = k (1/2 - l_i^2 / s (1 - 2 d^2 / s)), s = l_i^2 + l_j^2, in rows and columns.
    """
    square = length_scale**2
    inverse_spread = 1.0 / (square[:, None] + square)
    weighted = g * (1.0 - 2.0 * _square_distance(r, r) * inverse_spread) * inverse_spread
    result: FloatArray = 2.0 * square * weighted.sum(axis=1)
    return result


def _square_distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Squares of the distances between places, (A, B) [m^2]."""
    result: FloatArray = (a[:, None] - b) ** 2
    return result


class _Latent(NamedTuple):
    """Latent process of a segment with p pseudo-inputs at the ranges of its n inliers."""

    u: FloatArray  # (n,) log length-scale
    sigma_l_bar: float
    sigma_n_bar: float
    kind: IntArray  # (p,) entry of L-bar of each pseudo-input
    k_bar: FloatArray  # (p, p) without noise
    k_star: FloatArray  # (n, p)
    distance2: FloatArray  # (p, p)
    star_distance2: FloatArray  # (n, p)
    factor: FloatArray  # (p, p) Cholesky factor of B
    inverse: FloatArray  # (p, p) of B
    beta: FloatArray  # (p,)

    @classmethod
    def of(cls, theta: FloatArray, inliers: Inliers, m: int, r: FloatArray) -> _Latent:
        sigma_f_bar, sigma_l_bar, sigma_n_bar = np.exp(theta[2:5])
        bar = slice(inliers.bar_offsets[m], inliers.bar_offsets[m + 1])
        r_bar, kind = inliers.r_bar[bar], inliers.kind[bar]
        l_bar = inliers.log_extent[bar] + theta[5 + kind]
        kernel = sigma_f_bar**2, 0.5 / sigma_l_bar**2
        k_bar = squared_exponential(r_bar[:, None], r_bar, *kernel)
        k_star = squared_exponential(r[:, None], r_bar, *kernel)
        b = k_bar + sigma_n_bar**2 * np.eye(len(r_bar))
        inverse = np.linalg.inv(b)
        beta = inverse @ (l_bar - l_bar.mean())
        u = l_bar.mean() + k_star @ beta
        return cls(
            u=np.clip(u, -MAX_ABS_LOG_LENGTH_SCALE, MAX_ABS_LOG_LENGTH_SCALE),
            sigma_l_bar=sigma_l_bar,
            sigma_n_bar=sigma_n_bar,
            kind=kind,
            k_bar=k_bar,
            k_star=k_star,
            distance2=_square_distance(r_bar, r_bar),
            star_distance2=_square_distance(r, r_bar),
            factor=np.linalg.cholesky(b),
            inverse=inverse,
            beta=beta,
        )

    def add_gradient(self, gradient: FloatArray, g_u: FloatArray, latent_terms: bool) -> float:
        """Propagate the derivatives in u to theta; return the latent terms of the value."""
        beta, weight = self.beta, self.inverse @ (g_u @ self.k_star)
        # u is the mean of L-bar and what the process makes of the differences from it.
        g_l_bar = weight + (g_u.sum() - weight.sum()) / len(beta)
        gradient[5:] += np.bincount(self.kind, g_l_bar, minlength=len(gradient) - 5)

        # Adjoints of k_star and of B: every derivative is contracted with them.
        star = g_u[:, None] * self.k_star * beta
        adjoint = -np.outer(weight, beta)
        if latent_terms:
            adjoint -= 0.5 * self.inverse
        gradient[4] += 2.0 * self.sigma_n_bar**2 * np.trace(adjoint)
        adjoint *= self.k_bar
        gradient[2] += 2.0 * (star.sum() + adjoint.sum())
        contracted = np.sum(star * self.star_distance2) + np.sum(adjoint * self.distance2)
        gradient[3] += contracted / self.sigma_l_bar**2
        if not latent_terms:
            return 0.0
        return -float(np.log(np.diagonal(self.factor)).sum() + 0.5 * len(beta) * _LOG_2PI)
