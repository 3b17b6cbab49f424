"""Loops of `gp_ground_seg.core.gp.likelihood`, in which compiled code spends its time."""

import math

import numpy as np

from gp_ground_seg.core.compiled.numerics import times
from gp_ground_seg.core.frame import FloatArray, IntArray
from gp_ground_seg.core.gp import likelihood
from gp_ground_seg.core.gp.kernels import (
    inverted,
    line_covariance,
    line_variances,
    paciorek,
    squared_exponential,
)
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.gp.likelihood import LOG_2PI, Latent
from gp_ground_seg.core.jit import compiled_form
from gp_ground_seg.core.parameters.config import ObservationConfig


@compiled_form(likelihood.observe)
def observe(
    theta: FloatArray,
    gradient: FloatArray,
    r: FloatArray,
    z: FloatArray,
    u: FloatArray,
    observation: ObservationConfig,
) -> tuple[float, FloatArray]:
    """Do what the twin does; of K, A and the derivatives there are upper triangles."""
    # Unsigned indices: see `numerics`.
    n, one, length_scale = np.uintp(len(r)), np.uintp(1), np.exp(u)
    variance, noise = math.exp(2.0 * theta[0]), math.exp(2.0 * theta[1])
    slope, sixth = line_variances(observation)
    k, covariance = np.empty((len(r), len(r))), np.empty((len(r), len(r)))
    for i in range(n):
        r_i, l_i = r[i], length_scale[i]
        for j in range(i, n):
            value = paciorek(r_i, l_i, r[j], length_scale[j], variance)
            k[i, j] = value
            covariance[i, j] = value + line_covariance(r_i, r[j], slope, sixth)
        covariance[i, i] += noise
    inverse, log_root = inverted(covariance)
    alpha, value = times(inverse, z), -0.5 * len(r) * LOG_2PI - log_root
    for i in range(n):
        value -= 0.5 * z[i] * alpha[i]
    # The derivative in log k replaces k.
    g_sigma_f = g_noise = 0.0
    for i in range(n):
        alpha_i = alpha[i]
        on_diagonal = 0.5 * (alpha_i * alpha_i - inverse[i, i])
        g_noise += on_diagonal
        k[i, i] *= on_diagonal
        g_sigma_f += k[i, i]
        for j in range(i + one, n):
            g = 0.5 * (alpha_i * alpha[j] - inverse[i, j]) * k[i, j]
            k[i, j] = g
            g_sigma_f += 2.0 * g
    gradient[0] += 2.0 * g_sigma_f
    gradient[1] += 2.0 * noise * g_noise
    return value, k


@compiled_form(likelihood.predict)
def predict(
    theta: FloatArray, r_bar: FloatArray, log_extent: FloatArray, kind: IntArray, r: FloatArray
) -> Latent:
    """Do what the twin does."""
    n, p, shape = np.uintp(len(r)), np.uintp(len(r_bar)), (len(r_bar), len(r_bar))
    variance, noise = math.exp(2.0 * theta[2]), math.exp(2.0 * theta[4])
    k_bar, b, k_star = np.empty(shape), np.empty(shape), np.empty((len(r), len(r_bar)))
    sharpness, l_bar, mean = 0.5 * math.exp(-2.0 * theta[3]), np.empty(len(r_bar)), 0.0
    for i in range(p):
        l_bar[i] = log_extent[i] + theta[5 + kind[i]]
        mean, centre = mean + l_bar[i] / len(r_bar), r_bar[i]
        for j in range(p):
            value = squared_exponential(centre, r_bar[j], variance, sharpness)
            k_bar[i, j] = b[i, j] = value
        b[i, i] += noise
    for i in range(p):
        l_bar[i] -= mean
    inverse, log_root = inverted(b)
    beta, u = times(inverse, l_bar), np.empty(len(r))
    for i in range(n):
        value, place = mean, r[i]
        for j in range(p):
            k_star[i, j] = squared_exponential(place, r_bar[j], variance, sharpness)
            value += k_star[i, j] * beta[j]
        u[i] = min(max(value, -MAX_ABS_LOG_LENGTH_SCALE), MAX_ABS_LOG_LENGTH_SCALE)
    return Latent(u, r_bar, kind, k_bar, k_star, inverse, log_root, beta)


@compiled_form(likelihood.add_latent)
def add_latent(
    theta: FloatArray,
    gradient: FloatArray,
    latent: Latent,
    r: FloatArray,
    g: FloatArray,
    latent_terms: bool,
) -> float:
    """Do what the twin does."""
    r_bar, beta, k_bar, k_star = latent.r_bar, latent.beta, latent.k_bar, latent.k_star
    n, p, one, inverse = np.uintp(len(r)), np.uintp(len(r_bar)), np.uintp(1), latent.inverse
    square, g_u, raised = np.exp(2.0 * latent.u), np.zeros(len(r)), np.zeros(len(r_bar))
    total = g_sigma_f = g_sigma_l = g_noise = 0.0
    for i in range(n):
        # The rows before have added to this one; on the diagonal the derivative is 0.
        r_i, square_i, g_i = r[i], square[i], g_u[i]
        for j in range(i + one, n):
            d, inverse_spread = r_i - r[j], 1.0 / (square_i + square[j])
            bent = 2.0 * g[i, j] * inverse_spread * (1.0 - 2.0 * d * d * inverse_spread)
            g_i += g[i, j] - square_i * bent
            g_u[j] += g[i, j] - square[j] * bent
        if abs(latent.u[i]) >= MAX_ABS_LOG_LENGTH_SCALE:
            g_i = 0.0
        total += g_i
        for j in range(p):
            d, along = r_i - r_bar[j], g_i * k_star[i, j]
            raised[j] += along
            g_sigma_f += along * beta[j]
            g_sigma_l += along * beta[j] * d * d
    weight, share = times(inverse, raised), 0.5 if latent_terms else 0.0
    for i in range(p):
        total -= weight[i]
        g_noise -= weight[i] * beta[i] + share * inverse[i, i]
        for j in range(p):
            d, adjoint = r_bar[i] - r_bar[j], -weight[i] * beta[j] - share * inverse[i, j]
            g_sigma_f += adjoint * k_bar[i, j]
            g_sigma_l += adjoint * k_bar[i, j] * d * d
    for i in range(p):
        gradient[5 + latent.kind[i]] += weight[i] + total / len(r_bar)
    gradient[2] += 2.0 * g_sigma_f
    gradient[3] += g_sigma_l * math.exp(-2.0 * theta[3])
    gradient[4] += 2.0 * math.exp(2.0 * theta[4]) * g_noise
    return -(latent.log_root + 0.5 * len(r_bar) * LOG_2PI) if latent_terms else 0.0
