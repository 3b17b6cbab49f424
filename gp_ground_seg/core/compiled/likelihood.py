"""Compiled twin of `gp_ground_seg.core.gp.likelihood`; for its indices see `numerics`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.compiled.numerics import factorise, invert
from gp_ground_seg.core.frame import FloatArray, Inliers, IntArray
from gp_ground_seg.core.gp.kernels import (
    line_covariance,
    line_variances,
    paciorek,
    squared_exponential,
)
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import ObservationConfig

_LOG_2PI = math.log(2.0 * math.pi)


class _Latent(NamedTuple):
    """Latent process of a segment with p pseudo-inputs, at the ranges of its n inliers."""

    r_bar: FloatArray  # (p,) ranges of the pseudo-inputs [m]
    k_bar: FloatArray  # (p, p) without noise
    factor: FloatArray  # (p, p) Cholesky factor of B
    inverse: FloatArray  # (p, p) of B
    k_star: FloatArray  # (n, p)
    beta: FloatArray  # (p,)


def log_likelihood(
    theta: FloatArray,
    inliers: Inliers,
    observation: ObservationConfig,
    latent_terms: bool,
    gradient: FloatArray,
) -> float:
    """Return what the twin returns, and set `gradient` (T,): `set_likelihood` in compiled code."""
    value, own = 0.0, np.empty(len(theta))
    for i in range(len(theta)):
        gradient[i] = 0.0
    for m in range(len(inliers.offsets) - 1):
        value += _of_segment(theta, inliers, m, observation, latent_terms, own)
        if not math.isfinite(value):
            for i in range(len(theta)):
                gradient[i] = 0.0
            return -math.inf
        for i in range(len(theta)):
            gradient[i] += own[i]
    return value


@jit()
def _of_segment(
    theta: FloatArray,
    inliers: Inliers,
    m: int,
    observation: ObservationConfig,
    latent_terms: bool,
    gradient: FloatArray,
) -> float:
    """Return the value of segment `m`, -inf where it is not defined; set its gradient."""
    first, bar_first = inliers.offsets[m], inliers.bar_offsets[m]
    n, p = inliers.offsets[m + 1] - first, inliers.bar_offsets[m + 1] - bar_first
    for i in range(len(theta)):
        gradient[i] = 0.0
    if n == 0:
        return 0.0
    r, z = inliers.r[first : first + n], inliers.z[first : first + n]
    u = np.empty(n)
    for i in range(n):
        u[i] = inliers.log_length_scale[first + i]
    latent = _Latent(
        inliers.r_bar[bar_first : bar_first + p],
        np.empty((p, p)),
        np.empty((p, p)),
        np.empty((p, p)),
        np.empty((n, p)),
        np.zeros(p),
    )
    l_bar, kind = np.empty(p), inliers.kind[bar_first : bar_first + p]
    for i in range(p):
        l_bar[i] = inliers.log_extent[bar_first + i] + theta[5 + kind[i]]
    if p > 0 and not _predict_log_length_scales(theta, l_bar, r, latent, u):
        return -math.inf
    k, factor, whitened = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    if not _factorise_covariance(theta, observation, r, u, k, factor):
        return -math.inf
    g_u, inverse = np.zeros(n), np.empty((n, n))
    invert(factor, n, whitened, inverse)
    value: float = _of_observations(theta, r, z, u, k, factor, inverse, gradient, g_u)
    if p == 0:
        return value
    return value + _of_latent_process(theta, latent_terms, r, kind, latent, g_u, gradient)


@jit(part=True)
def _predict_log_length_scales(
    theta: FloatArray, l_bar: FloatArray, r: FloatArray, latent: _Latent, u: FloatArray
) -> bool:
    """Set the arrays of `latent`, and `u`; False if B is not positive definite."""
    r_bar, n, p = latent.r_bar, np.uintp(len(r)), np.uintp(len(latent.r_bar))
    k_bar, factor, k_star = latent.k_bar, latent.factor, latent.k_star
    variance, noise = math.exp(theta[2]) ** 2, math.exp(theta[4]) ** 2
    sharpness = 0.5 / math.exp(theta[3]) ** 2
    mean = 0.0
    for i in range(p):
        mean += l_bar[i] / p
        centre = r_bar[i]
        for j in range(p):
            value = squared_exponential(centre, r_bar[j], variance, sharpness)
            k_bar[i, j] = factor[i, j] = value
        factor[i, i] += noise
    if not factorise(factor, len(r_bar)):
        return False
    invert(factor, len(r_bar), np.empty(factor.shape), latent.inverse)
    for i in range(p):
        for j in range(p):
            latent.beta[i] += latent.inverse[i, j] * (l_bar[j] - mean)
    for i in range(n):
        value, centre = mean, r[i]
        for j in range(p):
            k_star[i, j] = squared_exponential(centre, r_bar[j], variance, sharpness)
            value += k_star[i, j] * latent.beta[j]
        u[i] = min(max(value, -MAX_ABS_LOG_LENGTH_SCALE), MAX_ABS_LOG_LENGTH_SCALE)
    return True


@jit(part=True)
def _factorise_covariance(
    theta: FloatArray,
    observation: ObservationConfig,
    r: FloatArray,
    u: FloatArray,
    k: FloatArray,
    factor: FloatArray,
) -> bool:
    """Set the upper triangles of K, and of the factor of A; False if that is not possible."""
    n, variance, noise = np.uintp(len(r)), math.exp(theta[0]) ** 2, math.exp(theta[1]) ** 2
    length_scale = np.empty(len(r))
    for i in range(n):
        length_scale[i] = math.exp(u[i])
    slope, sixth = line_variances(observation)
    for i in range(n):
        r_i, l_i = r[i], length_scale[i]
        for j in range(i, n):
            value = paciorek(r_i, l_i, r[j], length_scale[j], variance)
            k[i, j] = value
            factor[i, j] = value + line_covariance(r_i, r[j], slope, sixth)
        factor[i, i] += noise
    return factorise(factor, len(r))


@jit(part=True)
def _of_observations(
    theta: FloatArray,
    r: FloatArray,
    z: FloatArray,
    u: FloatArray,
    k: FloatArray,
    factor: FloatArray,
    inverse: FloatArray,
    gradient: FloatArray,
    g_u: FloatArray,
) -> float:
    """Return the value of the observations; set their gradient, and that in `u`."""
    n, one = np.uintp(len(r)), np.uintp(1)
    alpha, square = np.zeros(len(r)), np.empty(len(r))
    value = -0.5 * len(r) * _LOG_2PI
    for i in range(n):
        for j in range(n):
            alpha[i] += inverse[i, j] * z[j]
        value -= 0.5 * z[i] * alpha[i] + math.log(factor[i, i])
        square[i] = math.exp(2.0 * u[i])
    g_sigma_f = g_trace = 0.0
    for i in range(n):
        g_ii = 0.5 * (alpha[i] * alpha[i] - inverse[i, i])
        g_trace += g_ii
        g_sigma_f += 2.0 * g_ii * k[i, i]
        alpha_i, r_i, square_i = alpha[i], r[i], square[i]
        total = g_u_i = 0.0
        for j in range(i + one, n):
            g_k = (alpha_i * alpha[j] - inverse[i, j]) * k[i, j]
            total += g_k
            d = r_i - r[j]
            # l_i^2 / (l_i^2 + l_j^2), from which dlog k / du follows.
            inverse_spread = 1.0 / (square_i + square[j])
            ratio = square_i * inverse_spread
            curvature = 2.0 * d * d * inverse_spread
            g_u_i += g_k * (0.5 - ratio + ratio * curvature)
            g_u[j] += g_k * (ratio - 0.5 + (1.0 - ratio) * curvature)
        g_sigma_f += 2.0 * total
        g_u[i] += g_u_i
    gradient[0] = g_sigma_f
    gradient[1] = 2.0 * math.exp(theta[1]) ** 2 * g_trace
    for i in range(n):
        if abs(u[i]) >= MAX_ABS_LOG_LENGTH_SCALE:
            g_u[i] = 0.0
    return value


@jit(part=True)
def _of_latent_process(
    theta: FloatArray,
    latent_terms: bool,
    r: FloatArray,
    kind: IntArray,
    latent: _Latent,
    g_u: FloatArray,
    gradient: FloatArray,
) -> float:
    """Propagate the gradient in u to theta; return the latent terms of the value."""
    r_bar, beta, n, p = latent.r_bar, latent.beta, np.uintp(len(r)), np.uintp(len(latent.r_bar))
    k_bar, inverse, k_star = latent.k_bar, latent.inverse, latent.k_star
    weight, raised = np.zeros(len(r_bar)), np.zeros(len(r_bar))
    value = g_sigma_f_bar = g_sigma_l_bar = g_noise_bar = rest = 0.0
    for i in range(n):
        rest += g_u[i] / p
        g_i, r_i = g_u[i], r[i]
        for j in range(p):
            raised[j] += k_star[i, j] * g_i
            d = r_i - r_bar[j]
            term = g_i * k_star[i, j] * beta[j]
            g_sigma_f_bar += term
            g_sigma_l_bar += term * d * d
    share = 0.5 if latent_terms else 0.0
    for i in range(p):
        r_i = r_bar[i]
        for j in range(p):
            weight[i] += inverse[i, j] * raised[j]
        if latent_terms:
            value -= math.log(latent.factor[i, i]) + 0.5 * _LOG_2PI
        for j in range(p):
            d = r_i - r_bar[j]
            # Adjoint of B: every derivative of B is contracted with it.
            adjoint = -weight[i] * beta[j] - share * inverse[i, j]
            g_sigma_f_bar += adjoint * k_bar[i, j]
            g_sigma_l_bar += adjoint * k_bar[i, j] * d * d
        g_noise_bar -= weight[i] * beta[i] + share * inverse[i, i]
        gradient[5 + kind[i]] += weight[i]
        rest -= weight[i] / p
    # u is the mean of L-bar and what the process makes of the differences from it.
    for i in range(p):
        gradient[5 + kind[i]] += rest
    gradient[2] = 2.0 * g_sigma_f_bar
    gradient[3] = g_sigma_l_bar / math.exp(theta[3]) ** 2
    gradient[4] = 2.0 * math.exp(theta[4]) ** 2 * g_noise_bar
    return value
