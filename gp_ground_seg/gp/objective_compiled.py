"""Whole-frame objective and its gradient, compiled, one row of results per segment."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.compiled import compiled
from gp_ground_seg.gp.kernels import NEGLIGIBLE_EXPONENT
from gp_ground_seg.gp.linalg import factorise, invert
from gp_ground_seg.polar_grid import FloatArray, IntArray

_LOG_2PI = math.log(2.0 * math.pi)


@compiled
def _decay(exponent: float) -> float:
    """``exp(-exponent)``, zero where it is below the rounding of one."""
    return math.exp(-exponent) if exponent < NEGLIGIBLE_EXPONENT else 0.0


@compiled
def objective_rows(
    start: int,
    stop: int,
    step: int,
    theta: FloatArray,
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    fixed_u: FloatArray,
    bar_offsets: IntArray,
    r_bar: FloatArray,
    surface_class: IntArray,
    slope_std: float,
    latent_terms: bool,
    values: FloatArray,
    gradients: FloatArray,
) -> None:
    """Do what `gp_ground_seg.gp.objective.objective_reference` does, segment by segment.

    ``values[m]`` and ``gradients[m]`` are set for segments ``start:stop:step``.
    """
    sigma_f, sigma_n = math.exp(theta[0]), math.exp(theta[1])
    sigma_f_bar, sigma_l_bar = math.exp(theta[2]), math.exp(theta[3])
    sigma_n_bar = math.exp(theta[4])
    for m in range(start, stop, step):
        first, bar_first = offsets[m], bar_offsets[m]
        n, p = offsets[m + 1] - first, bar_offsets[m + 1] - bar_first
        gradients[m] = 0.0
        values[m] = 0.0
        if n == 0:
            continue
        u = np.empty(n)
        l_bar = np.empty(p)
        k_bar = np.empty((p, p))
        b_factor = np.empty((p, p))
        b_inverse = np.empty((p, p))
        k_star = np.empty((n, p))
        beta = np.zeros(p)
        mean = 0.0
        if p > 0:
            for i in range(p):
                l_bar[i] = theta[5 + surface_class[bar_first + i]]
                mean += l_bar[i] / p
                for j in range(i + 1):
                    d = r_bar[bar_first + i] - r_bar[bar_first + j]
                    value = sigma_f_bar**2 * _decay(0.5 * d * d / sigma_l_bar**2)
                    k_bar[i, j] = k_bar[j, i] = value
                    b_factor[i, j] = b_factor[j, i] = value
                b_factor[i, i] += sigma_n_bar**2
            if not factorise(b_factor, p):
                values[m] = -np.inf
                continue
            invert(b_factor, p, np.empty((p, p)), b_inverse)
            for i in range(p):
                for j in range(p):
                    beta[i] += b_inverse[i, j] * (l_bar[j] - mean)
            for i in range(n):
                u[i] = mean
                for j in range(p):
                    d = r[first + i] - r_bar[bar_first + j]
                    k_star[i, j] = sigma_f_bar**2 * _decay(0.5 * d * d / sigma_l_bar**2)
                    u[i] += k_star[i, j] * beta[j]
        else:
            for i in range(n):
                u[i] = fixed_u[first + i]

        length_scale = np.exp(u)
        square = length_scale * length_scale
        k = np.empty((n, n))
        factor = np.empty((n, n))
        for i in range(n):
            for j in range(i + 1):
                spread = square[i] + square[j]
                d = r[first + i] - r[first + j]
                value = _decay(d * d / spread)
                if value > 0.0:
                    root = math.sqrt(2.0 * length_scale[i] * length_scale[j] / spread)
                    value *= sigma_f**2 * root
                k[i, j] = value
                factor[j, i] = value + slope_std**2 * r[first + i] * r[first + j]
            factor[i, i] += sigma_n**2
        if not factorise(factor, n):
            values[m] = -np.inf
            continue
        inverse = np.empty((n, n))
        invert(factor, n, np.empty((n, n)), inverse)
        alpha = np.zeros(n)
        for i in range(n):
            for j in range(n):
                alpha[i] += inverse[i, j] * z[first + j]
        value = -0.5 * n * _LOG_2PI
        for i in range(n):
            value -= 0.5 * z[first + i] * alpha[i] + math.log(factor[i, i])

        g_sigma_f = g_trace = 0.0
        g_u = np.zeros(n)
        for i in range(n):
            g_ii = 0.5 * (alpha[i] * alpha[i] - inverse[i, i])
            g_trace += g_ii
            g_sigma_f += 2.0 * g_ii * k[i, i]
            for j in range(i):
                if k[i, j] == 0.0:
                    continue
                g_k = 0.5 * (alpha[i] * alpha[j] - inverse[i, j]) * k[i, j]
                g_sigma_f += 4.0 * g_k
                spread = square[i] + square[j]
                d = r[first + i] - r[first + j]
                ratio = square[i] / spread
                twist = 2.0 * d * d / spread
                g_u[i] += 2.0 * g_k * (0.5 - ratio + ratio * twist)
                g_u[j] += 2.0 * g_k * (ratio - 0.5 + (1.0 - ratio) * twist)
        gradients[m, 0] = g_sigma_f
        gradients[m, 1] = 2.0 * sigma_n**2 * g_trace
        values[m] = value
        if p == 0:
            continue

        weight = np.zeros(p)
        raised = np.zeros(p)
        g_sum = 0.0
        for i in range(n):
            g_sum += g_u[i]
            for j in range(p):
                raised[j] += k_star[i, j] * g_u[i]
        weight_sum = 0.0
        for i in range(p):
            for j in range(p):
                weight[i] += b_inverse[i, j] * raised[j]
            weight_sum += weight[i]
            if latent_terms:
                value -= math.log(b_factor[i, i]) + 0.5 * _LOG_2PI
        for i in range(p):
            slot = 5 + surface_class[bar_first + i]
            gradients[m, slot] += weight[i] + (g_sum - weight_sum) / p
        for j in range(p):
            for i in range(n):
                if k_star[i, j] == 0.0:
                    continue
                d = r[first + i] - r_bar[bar_first + j]
                term = g_u[i] * k_star[i, j] * beta[j]
                gradients[m, 2] += 2.0 * term
                gradients[m, 3] += term * d * d / sigma_l_bar**2
            for i in range(p):
                d = r_bar[bar_first + i] - r_bar[bar_first + j]
                # Adjoint of B: every derivative of B is contracted with it.
                adjoint = -weight[i] * beta[j]
                if latent_terms:
                    adjoint -= 0.5 * b_inverse[i, j]
                gradients[m, 2] += 2.0 * adjoint * k_bar[i, j]
                gradients[m, 3] += adjoint * k_bar[i, j] * d * d / sigma_l_bar**2
                if i == j:
                    gradients[m, 4] += 2.0 * adjoint * sigma_n_bar**2
        values[m] = value
