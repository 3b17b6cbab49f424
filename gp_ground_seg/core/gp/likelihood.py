"""Log marginal likelihood of a whole frame and its gradient, in batches of segments."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray, Inliers, IntArray, Values
from gp_ground_seg.core.gp.kernels import paciorek, squared_exponential
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.gp.linalg import Padded, add_noise, batches, single_threaded_blas

_LOG_2PI = math.log(2.0 * math.pi)


@single_threaded_blas()
def log_likelihood(
    theta: FloatArray, inliers: Inliers, slope_std: float, latent_terms: bool
) -> tuple[float, FloatArray]:
    """Log marginal likelihood of a frame and its gradient (paper, eqs. 19 and 20).

    `theta`, (T,), holds the logarithms of sigma_f, sigma_n [m], sigma_f_bar [log m],
    sigma_l_bar [m], sigma_n_bar [log m], and of the factors on the length-scales of the lines.
    `slope_std` is the prior standard deviation of the mean line's slope: the line through the
    sensor's base is marginalised, which adds ``slope_std^2 r r'`` to the kernel (Rasmussen and
    Williams 2006, section 2.7). With `latent_terms` the terms of the latent process,
    ``-1/2 log|B_m|``, are in: the objective is the printed one, which has no upper bound.

    Returns the value, ``-inf`` where a covariance is not positive definite, and its gradient in
    `theta`, (T,).
    """
    value, gradient = 0.0, np.zeros(len(theta))
    try:
        for segments in batches(inliers.offsets):
            value += _add_batch(theta, gradient, inliers, segments, slope_std, latent_terms)
    except np.linalg.LinAlgError:
        value = -math.inf
    if not math.isfinite(value):
        return -math.inf, np.zeros(len(theta))
    return value, gradient


def _add_batch(
    theta: FloatArray,
    gradient: FloatArray,
    inliers: Inliers,
    segments: IntArray,
    slope_std: float,
    latent_terms: bool,
) -> float:
    """Value of some segments; adds to `gradient`. Letters are those of the paper."""
    layout = Padded.of(segments, inliers.offsets)
    r, z = layout.take(inliers.r), layout.take(inliers.z)
    bar = Padded.of(segments, inliers.bar_offsets)
    u = layout.take(inliers.log_length_scale)
    has_latent = bar.mask.any(axis=1, keepdims=True)
    latent = _Latent.of(theta, inliers, bar, r) if has_latent.any() else None
    if latent is not None:
        u = np.where(has_latent, latent.u, u)

    sigma_f, sigma_n = np.exp(theta[:2])
    length_scale = np.where(layout.mask, np.exp(u), 1.0)
    a, b = (r[:, :, None], length_scale[:, :, None]), (r[:, None, :], length_scale[:, None, :])
    k = paciorek(*a, *b, sigma_f**2)
    k *= layout.mask[:, :, None] & layout.mask[:, None, :]
    covariance = k + slope_std**2 * r[:, :, None] * r[:, None, :]
    add_noise(covariance, np.full((1, 1), sigma_n**2), layout.mask)
    factor = np.linalg.cholesky(covariance)
    a_inverse = np.linalg.inv(covariance)
    alpha = (a_inverse @ z[:, :, None])[:, :, 0]
    value = -0.5 * float(
        np.sum(z * alpha)
        + 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum()
        + layout.mask.sum() * _LOG_2PI
    )

    # G = (alpha alpha^T - A^-1) / 2 is the derivative of the value in A.
    g = 0.5 * (alpha[:, :, None] * alpha[:, None, :] - a_inverse)
    gradient[1] += 2.0 * sigma_n**2 * np.diagonal(g, axis1=1, axis2=2)[layout.mask].sum()
    g *= k
    row_sum = g.sum(axis=2)
    gradient[0] += 2.0 * row_sum.sum()
    if latent is None:
        return value
    is_bounded = np.abs(u) >= MAX_ABS_LOG_LENGTH_SCALE
    is_free = layout.mask & has_latent & ~is_bounded
    g_u = np.where(is_free, row_sum - _curvature(g, r, length_scale), 0.0)
    return value + latent.add_gradient(gradient, g_u, latent_terms)


def _curvature(g: Values, r: FloatArray, length_scale: FloatArray) -> FloatArray:
    """Part of the derivative in u that depends on the distances; `g` is that in log k.

    dk/du_i = k (1/2 - l_i^2 / s (1 - 2 d^2 / s)), s = l_i^2 + l_j^2, in rows and columns.
    """
    square = length_scale**2
    inverse_spread = 1.0 / (square[:, :, None] + square[:, None, :])
    distance2 = (r[:, :, None] - r[:, None, :]) ** 2
    weighted = g * (1.0 - 2.0 * distance2 * inverse_spread) * inverse_spread
    result: FloatArray = 2.0 * square * weighted.sum(axis=2)
    return result


class _Latent(NamedTuple):
    """Latent process of S segments with p pseudo-inputs at the ranges of n inliers."""

    u: FloatArray  # (S, n) log length-scale
    sigma_l_bar: float
    sigma_n_bar: float
    bar: Padded
    kind: IntArray  # (S, p) entry of L-bar of each pseudo-input
    k_bar: FloatArray  # (S, p, p) without noise
    k_star: FloatArray  # (S, n, p)
    distance2: FloatArray  # (S, p, p)
    star_distance2: FloatArray  # (S, n, p)
    factor: FloatArray  # (S, p, p) Cholesky factor of B
    inverse: FloatArray  # (S, p, p) of B
    beta: FloatArray  # (S, p)

    @classmethod
    def of(cls, theta: FloatArray, inliers: Inliers, bar: Padded, r: FloatArray) -> _Latent:
        sigma_f_bar, sigma_l_bar, sigma_n_bar = np.exp(theta[2:5])
        r_bar = bar.take(inliers.r_bar)
        kind = inliers.kind[bar.place]
        l_bar = np.where(bar.mask, bar.take(inliers.log_extent) + theta[5 + kind], 0.0)
        mean = l_bar.sum(axis=1, keepdims=True) / np.maximum(bar.mask.sum(axis=1), 1)[:, None]
        kernel = sigma_f_bar**2, 0.5 / sigma_l_bar**2
        k_bar = squared_exponential(r_bar[:, :, None], r_bar[:, None, :], *kernel)
        k_bar *= bar.mask[:, :, None] & bar.mask[:, None, :]
        k_star = squared_exponential(r[:, :, None], r_bar[:, None, :], *kernel)
        k_star *= bar.mask[:, None, :]
        b = add_noise(k_bar.copy(), np.full((1, 1), sigma_n_bar**2), bar.mask)
        inverse = np.linalg.inv(b).astype(np.float64, copy=False)
        factor = np.linalg.cholesky(b).astype(np.float64, copy=False)
        beta: FloatArray = (inverse @ np.where(bar.mask, l_bar - mean, 0.0)[:, :, None])[:, :, 0]
        u = mean + (k_star @ beta[:, :, None])[:, :, 0]
        return cls(
            u=np.clip(u, -MAX_ABS_LOG_LENGTH_SCALE, MAX_ABS_LOG_LENGTH_SCALE),
            sigma_l_bar=sigma_l_bar,
            sigma_n_bar=sigma_n_bar,
            bar=bar,
            kind=kind,
            k_bar=k_bar,
            k_star=k_star,
            distance2=(r_bar[:, :, None] - r_bar[:, None, :]) ** 2,
            star_distance2=(r[:, :, None] - r_bar[:, None, :]) ** 2,
            factor=factor,
            inverse=inverse,
            beta=beta,
        )

    def add_gradient(self, gradient: FloatArray, g_u: FloatArray, latent_terms: bool) -> float:
        """Propagate the derivatives in u to theta; return the latent terms of the value."""
        bar, beta = self.bar, self.beta
        weight = (self.inverse @ (g_u[:, None, :] @ self.k_star).swapaxes(1, 2))[:, :, 0]
        # u is the mean of L-bar and what the process makes of the differences from it.
        share = (g_u.sum(axis=1) - weight.sum(axis=1)) / np.maximum(bar.mask.sum(axis=1), 1)
        g_l_bar = (weight + share[:, None])[bar.mask]
        gradient[5:] += np.bincount(self.kind[bar.mask], g_l_bar, minlength=len(gradient) - 5)

        # Adjoints of k_star and of B: every derivative is contracted with them.
        star = g_u[:, :, None] * self.k_star * beta[:, None, :]
        adjoint = -weight[:, :, None] * beta[:, None, :]
        if latent_terms:
            adjoint -= 0.5 * self.inverse
        on_diagonal = np.diagonal(adjoint, axis1=1, axis2=2)[bar.mask].sum()
        gradient[4] += 2.0 * self.sigma_n_bar**2 * on_diagonal
        adjoint *= self.k_bar
        gradient[2] += 2.0 * (star.sum() + adjoint.sum())
        contracted = np.sum(star * self.star_distance2) + np.sum(adjoint * self.distance2)
        gradient[3] += contracted / self.sigma_l_bar**2
        if not latent_terms:
            return 0.0
        log_determinant = 2.0 * np.log(np.diagonal(self.factor, axis1=1, axis2=2)).sum()
        return -0.5 * float(log_determinant + bar.mask.sum() * _LOG_2PI)
