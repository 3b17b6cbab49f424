"""Whole-frame objective and its gradient, many segments at once, in plain numpy.

The obvious twin is `gp_ground_seg.gp.objective.objective_reference`.
"""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.frame import FloatArray, IntArray
from gp_ground_seg.gp.objective import N_SCALARS, TrainingFrame
from gp_ground_seg.gp.padding import Padded, batches, regularised

_LOG_2PI = math.log(2.0 * math.pi)


def objective_batched(
    theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
) -> tuple[float, FloatArray]:
    """Do what `objective_reference` does."""
    value, gradient = 0.0, np.zeros(len(theta))
    try:
        for segments in batches(frame.offsets):
            value += _batch(theta, gradient, frame, segments, slope_std, latent_terms)
    except np.linalg.LinAlgError:
        value = -math.inf
    if not math.isfinite(value):
        return -math.inf, np.zeros(len(theta))
    return value, gradient


def _batch(
    theta: FloatArray,
    gradient: FloatArray,
    frame: TrainingFrame,
    segments: IntArray,
    slope_std: float,
    latent_terms: bool,
) -> float:
    """Value of some segments; adds to `gradient`. Letters are those of the paper."""
    own = Padded.of(segments, frame.offsets)
    r, z = own.take(frame.r), own.take(frame.z)
    bar = Padded.of(segments, frame.bar_offsets)
    u = own.take(frame.log_length_scale)
    has_latent = bar.mask.any(axis=1, keepdims=True)
    latent = _Latent(theta, frame, bar, r) if has_latent.any() else None
    if latent is not None:
        u = np.where(has_latent, latent.u, u)

    sigma_f, sigma_n = np.exp(theta[:2])
    length_scale = np.where(own.mask, np.exp(u), 1.0)
    square = length_scale**2
    inverse_spread = 1.0 / (square[:, :, None] + square[:, None, :])
    exponent = r[:, :, None] - r[:, None, :]
    exponent *= exponent
    exponent *= inverse_spread
    k = np.exp(-exponent)
    k *= np.sqrt(inverse_spread * (2.0 * length_scale[:, :, None] * length_scale[:, None, :]))
    k *= sigma_f**2 * (own.mask[:, :, None] & own.mask[:, None, :])
    covariance = k + slope_std**2 * r[:, :, None] * r[:, None, :]
    regularised(covariance, np.full((1, 1), sigma_n**2), own.mask)
    factor = np.linalg.cholesky(covariance)
    a_inverse = np.linalg.inv(covariance)
    alpha = (a_inverse @ z[:, :, None])[:, :, 0]
    value = -0.5 * float(
        np.sum(z * alpha)
        + 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum()
        + own.mask.sum() * _LOG_2PI
    )

    a_inverse *= -0.5
    g = a_inverse
    g += 0.5 * alpha[:, :, None] * alpha[:, None, :]
    gradient[1] += 2.0 * sigma_n**2 * np.diagonal(g, axis1=1, axis2=2)[own.mask].sum()
    g *= k
    row_sum = g.sum(axis=2)
    gradient[0] += 2.0 * row_sum.sum()
    if latent is None:
        return value
    # dk/du_i = k (1/2 - l_i^2 / s (1 - 2 d^2 / s)), s = l_i^2 + l_j^2, both ways round.
    exponent *= -2.0
    exponent += 1.0
    g *= exponent
    g *= inverse_spread
    g_u = row_sum - 2.0 * square * g.sum(axis=2)
    g_u = np.where(own.mask & has_latent, g_u, 0.0)
    return value + latent.add_gradient(gradient, g_u, latent_terms)


class _Latent:
    """Latent process of some segments at the inliers' ranges `r`, (S, n)."""

    def __init__(
        self, theta: FloatArray, frame: TrainingFrame, bar: Padded, r: FloatArray
    ) -> None:
        sigma_f_bar, sigma_l_bar, sigma_n_bar = np.exp(theta[2:N_SCALARS])
        self._sigma_l_bar, self._sigma_n_bar = sigma_l_bar, sigma_n_bar
        self._bar = bar
        self._surface_class = frame.surface_class
        r_bar = bar.take(frame.r_bar)
        both = bar.mask[:, :, None] & bar.mask[:, None, :]
        self._count = bar.mask.sum(axis=1)
        l_bar = bar.take(theta[N_SCALARS + frame.surface_class])
        mean = l_bar.sum(axis=1) / np.maximum(self._count, 1)
        self._distance2 = (r_bar[:, :, None] - r_bar[:, None, :]) ** 2
        self._star_distance2 = (r[:, :, None] - r_bar[:, None, :]) ** 2
        decay = -0.5 / sigma_l_bar**2
        self._k = sigma_f_bar**2 * np.exp(decay * self._distance2) * both
        self._k_star = sigma_f_bar**2 * np.exp(decay * self._star_distance2)
        self._k_star *= bar.mask[:, None, :]
        noise = np.full((1, 1), sigma_n_bar**2)
        b = regularised(self._k.copy(), noise, bar.mask)
        self._factor = np.linalg.cholesky(b)
        self._inverse = np.linalg.inv(b)
        centred = np.where(bar.mask, l_bar - mean[:, None], 0.0)
        self._beta = (self._inverse @ centred[:, :, None])[:, :, 0]
        self.u = mean[:, None] + (self._k_star @ self._beta[:, :, None])[:, :, 0]

    def add_gradient(self, gradient: FloatArray, g_u: FloatArray, latent_terms: bool) -> float:
        """Carry the derivatives in u on to theta; return the latent terms of the value."""
        bar, beta = self._bar, self._beta
        raised = (g_u[:, None, :] @ self._k_star)[:, 0, :]
        weight = (self._inverse @ raised[:, :, None])[:, :, 0]
        shared = (g_u.sum(axis=1) - weight.sum(axis=1)) / np.maximum(self._count, 1)
        g_l_bar = (weight + shared[:, None])[bar.mask]
        classes = self._surface_class[bar.index[bar.mask]]
        gradient[N_SCALARS:] += np.bincount(classes, g_l_bar, len(gradient) - N_SCALARS)

        # Adjoints of k_star and of B: every derivative is contracted with them.
        star = g_u[:, :, None] * self._k_star * beta[:, None, :]
        adjoint = -weight[:, :, None] * beta[:, None, :]
        if latent_terms:
            adjoint -= 0.5 * self._inverse
        gradient[4] += (
            2.0 * self._sigma_n_bar**2 * np.diagonal(adjoint, axis1=1, axis2=2)[bar.mask].sum()
        )
        adjoint *= self._k
        gradient[2] += 2.0 * (star.sum() + adjoint.sum())
        gradient[3] += (
            np.sum(star * self._star_distance2) + np.sum(adjoint * self._distance2)
        ) / self._sigma_l_bar**2
        if not latent_terms:
            return 0.0
        log_determinant = 2.0 * np.log(np.diagonal(self._factor, axis1=1, axis2=2)).sum()
        return -0.5 * float(log_determinant + bar.mask.sum() * _LOG_2PI)
