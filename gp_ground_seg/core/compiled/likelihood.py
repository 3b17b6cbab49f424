"""Compiled twin of `gp_ground_seg.core.gp.likelihood`, one row of results per segment."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.compiled.numerics import exp_neg, factorise, invert, invert_triangle
from gp_ground_seg.core.compiled.threads import Part
from gp_ground_seg.core.frame import FloatArray, Inliers
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.jit import jit

_LOG_2PI = math.log(2.0 * math.pi)


@jit(entry=True)
def log_likelihood(
    part: Part,
    theta: FloatArray,
    inliers: Inliers,
    slope_std: float,
    latent_terms: bool,
    values: FloatArray,
    gradients: FloatArray,
) -> None:
    """Set ``values[m]`` and ``gradients[m]`` of the segments of a part; -inf where not defined."""
    sigma_f, sigma_n = math.exp(theta[0]), math.exp(theta[1])
    sigma_f_bar, sigma_l_bar = math.exp(theta[2]), math.exp(theta[3])
    sigma_n_bar = math.exp(theta[4])
    for m in range(part.number, len(values), part.n_parts):
        first, bar_first = inliers.offsets[m], inliers.bar_offsets[m]
        n, p = inliers.offsets[m + 1] - first, inliers.bar_offsets[m + 1] - bar_first
        values[m] = 0.0
        for i in range(len(theta)):
            gradients[m, i] = 0.0
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
        own_r = inliers.r[first : first + n]
        own_z = inliers.z[first : first + n]
        own_r_bar = inliers.r_bar[bar_first : bar_first + p]
        sharpness = 0.5 / sigma_l_bar**2
        if p > 0:
            for i in range(p):
                l_bar[i] = inliers.log_extent[bar_first + i]
                mean += l_bar[i] / p
                centre = own_r_bar[i]
                for j in range(p):
                    d = centre - own_r_bar[j]
                    value = sigma_f_bar**2 * exp_neg(sharpness * d * d)
                    k_bar[i, j] = value
                    b_factor[i, j] = value
                b_factor[i, i] += sigma_n_bar**2
            if not factorise(b_factor, p):
                values[m] = -np.inf
                continue
            invert(b_factor, p, np.empty((p, p)), b_inverse)
            for i in range(p):
                for j in range(p):
                    beta[i] += b_inverse[i, j] * (l_bar[j] - mean)
            for i in range(n):
                value = mean + theta[5]
                centre = own_r[i]
                for j in range(p):
                    d = centre - own_r_bar[j]
                    covariance = sigma_f_bar**2 * exp_neg(sharpness * d * d)
                    k_star[i, j] = covariance
                    value += covariance * beta[j]
                u[i] = min(max(value, -MAX_ABS_LOG_LENGTH_SCALE), MAX_ABS_LOG_LENGTH_SCALE)
        else:
            for i in range(n):
                u[i] = inliers.log_length_scale[first + i]

        length_scale, square = np.empty(n), np.empty(n)
        for i in range(n):
            length_scale[i] = math.exp(u[i])
            square[i] = length_scale[i] * length_scale[i]
        k = np.empty((n, n))
        factor = np.empty((n, n))
        # l_i^2 / (l_i^2 + l_j^2), from which dlog k / du follows.
        ratios = np.empty((n, n))
        for i in range(n):
            centre, own_l, own_square = own_r[i], length_scale[i], square[i]
            tilt = slope_std**2 * centre
            row, ratio_row, factor_row = k[i], ratios[i], factor[i]
            for j in range(i, n):
                inverse_spread = 1.0 / (own_square + square[j])
                d = centre - own_r[j]
                exponent = d * d * inverse_spread
                root = math.sqrt(2.0 * own_l * length_scale[j] * inverse_spread)
                value = sigma_f**2 * root * exp_neg(exponent)
                row[j] = value
                factor_row[j] = value + tilt * own_r[j]
                ratio_row[j] = own_square * inverse_spread
            factor_row[i] += sigma_n**2
        if not factorise(factor, n):
            values[m] = -np.inf
            continue
        whitened = np.empty((n, n))
        alpha = np.zeros(n)
        if p == 0:
            # Both derivatives follow from traces: K is A without noise and slope.
            invert_triangle(factor, n, whitened)
            value = -0.5 * n * _LOG_2PI
            trace = square_sum = tilt_trace = tilt_sum = fit = 0.0
            for i in range(n):
                row = whitened[i]
                own_sum = own_tilt = 0.0
                for j in range(i + 1):
                    own_sum += row[j] * own_z[j]
                    own_tilt += row[j] * own_r[j]
                    trace += row[j] * row[j]
                for j in range(i + 1):
                    alpha[j] += row[j] * own_sum
                tilt_trace += own_tilt * own_tilt
                fit += own_sum * own_sum
                value -= math.log(factor[i, i])
            for i in range(n):
                square_sum += alpha[i] * alpha[i]
                tilt_sum += alpha[i] * own_r[i]
            noise, slope = sigma_n**2, slope_std**2
            gradients[m, 1] = noise * (square_sum - trace)
            gradients[m, 0] = fit - slope * tilt_sum * tilt_sum - n + slope * tilt_trace
            gradients[m, 0] -= gradients[m, 1]
            values[m] = value - 0.5 * fit
            continue
        inverse = np.empty((n, n))
        invert(factor, n, whitened, inverse)
        for i in range(n):
            value = 0.0
            row = inverse[i]
            for j in range(n):
                value += row[j] * own_z[j]
            alpha[i] = value
        value = -0.5 * n * _LOG_2PI
        for i in range(n):
            value -= 0.5 * own_z[i] * alpha[i] + math.log(factor[i, i])

        g_sigma_f = g_trace = 0.0
        g_u = np.zeros(n)
        for i in range(n):
            g_ii = 0.5 * (alpha[i] * alpha[i] - inverse[i, i])
            g_trace += g_ii
            g_sigma_f += 2.0 * g_ii * k[i, i]
            own_alpha, centre, own_square = alpha[i], own_r[i], square[i]
            row, ratio_row, inverse_row = k[i], ratios[i], inverse[i]
            total = own = 0.0
            for j in range(i + 1, n):
                g_k = (own_alpha * alpha[j] - inverse_row[j]) * row[j]
                total += g_k
                d = centre - own_r[j]
                ratio = ratio_row[j]
                curvature = 2.0 * d * d * ratio / own_square
                own += g_k * (0.5 - ratio + ratio * curvature)
                g_u[j] += g_k * (ratio - 0.5 + (1.0 - ratio) * curvature)
            g_sigma_f += 2.0 * total
            g_u[i] += own
        gradients[m, 0] = g_sigma_f
        gradients[m, 1] = 2.0 * sigma_n**2 * g_trace

        weight = np.zeros(p)
        raised = np.zeros(p)
        g_sum = 0.0
        for i in range(n):
            if abs(u[i]) >= MAX_ABS_LOG_LENGTH_SCALE:
                g_u[i] = 0.0
            g_sum += g_u[i]
            for j in range(p):
                raised[j] += k_star[i, j] * g_u[i]
        for i in range(p):
            for j in range(p):
                weight[i] += b_inverse[i, j] * raised[j]
            if latent_terms:
                value -= math.log(b_factor[i, i]) + 0.5 * _LOG_2PI
        gradients[m, 5] = g_sum
        g_sigma_f_bar = g_sigma_l_bar = g_noise_bar = 0.0
        share = 0.5 if latent_terms else 0.0
        for i in range(n):
            own, centre, row = g_u[i], own_r[i], k_star[i]
            for j in range(p):
                d = centre - own_r_bar[j]
                term = own * row[j] * beta[j]
                g_sigma_f_bar += term
                g_sigma_l_bar += term * d * d
        for i in range(p):
            own, centre, row, inverse_row = weight[i], own_r_bar[i], k_bar[i], b_inverse[i]
            for j in range(p):
                d = centre - own_r_bar[j]
                # Adjoint of B: every derivative of B is contracted with it.
                adjoint = -own * beta[j] - share * inverse_row[j]
                g_sigma_f_bar += adjoint * row[j]
                g_sigma_l_bar += adjoint * row[j] * d * d
            g_noise_bar -= own * beta[i] + share * inverse_row[i]
        gradients[m, 2] = 2.0 * g_sigma_f_bar
        gradients[m, 3] = g_sigma_l_bar / sigma_l_bar**2
        gradients[m, 4] = 2.0 * sigma_n_bar**2 * g_noise_bar
        values[m] = value
