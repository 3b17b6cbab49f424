"""Latent process and inlier growth of many segments at once, in plain numpy.

The obvious twins are `gp_ground_seg.gp.latent.latent_rows_reference` and
`gp_ground_seg.gp.growth.grow_surface_reference`.
"""

from __future__ import annotations

import numpy as np

from gp_ground_seg.frame import BoolArray, FloatArray, IntArray
from gp_ground_seg.gp.padding import Padded, batches, regularised
from gp_ground_seg.parameters.config import GrowthConfig


def latent_rows_batched(
    theta: FloatArray,
    bar_offsets: IntArray,
    r_bar: FloatArray,
    surface_class: IntArray,
    offsets: IntArray,
    r: FloatArray,
    knots: FloatArray,
    n_knots: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Do what `latent_rows_reference` does."""
    n_segments = len(offsets) - 1
    at_candidates = np.empty(len(r))
    at_knots = np.full((n_segments, len(knots)), np.nan)
    for segments in batches(offsets):
        own, bar = Padded.of(segments, offsets), Padded.of(segments, bar_offsets)
        own_r, own_r_bar = own.take(r), bar.take(r_bar)
        variance, noise = np.exp(2.0 * theta[segments, 2]), np.exp(2.0 * theta[segments, 4])
        decay = 0.5 * np.exp(-2.0 * theta[segments, 3])
        classes = bar.take(surface_class).astype(np.int64)
        l_bar = np.where(bar.mask, theta[segments[:, None], 5 + classes], 0.0)
        mean = l_bar.sum(axis=1) / bar.mask.sum(axis=1)
        covariance = _gaussian(own_r_bar, own_r_bar, variance, decay)
        regularised(covariance, noise[:, None], bar.mask)
        centred = np.where(bar.mask, l_bar - mean[:, None], 0.0)
        weight = np.linalg.solve(covariance, centred[:, :, None])
        value = (_gaussian(own_r, own_r_bar, variance, decay) @ weight)[:, :, 0]
        at_candidates[own.index[own.mask]] = (value + mean[:, None])[own.mask]
        wanted = np.broadcast_to(knots, (len(segments), len(knots)))
        value = (_gaussian(wanted, own_r_bar, variance, decay) @ weight)[:, :, 0]
        is_wanted = np.arange(len(knots)) < n_knots[segments, None]
        at_knots[segments] = np.where(is_wanted, value + mean[:, None], np.nan)
    return at_candidates, at_knots


def _gaussian(
    r_a: FloatArray, r_b: FloatArray, variance: FloatArray, decay: FloatArray
) -> FloatArray:
    """Squared exponentials, (S, a, b)."""
    result: FloatArray = r_a[:, :, None] - r_b[:, None, :]
    result *= result
    result *= -decay[:, None, None]
    np.exp(result, out=result)
    result *= variance[:, None, None]
    return result


def paciorek_batched(
    r_a: FloatArray, l_a: FloatArray, r_b: FloatArray, l_b: FloatArray, sigma_f: FloatArray
) -> FloatArray:
    """`gp_ground_seg.gp.kernels.paciorek` of many segments, (S, a, b)."""
    inverse = 1.0 / (l_a[:, :, None] ** 2 + l_b[:, None, :] ** 2)
    exponent: FloatArray = r_a[:, :, None] - r_b[:, None, :]
    exponent *= exponent
    exponent *= inverse
    np.negative(exponent, out=exponent)
    result: FloatArray = np.exp(exponent, out=exponent)
    inverse *= l_a[:, :, None]
    inverse *= 2.0 * l_b[:, None, :]
    result *= np.sqrt(inverse, out=inverse)
    result *= sigma_f[:, None, None] ** 2
    return result


def grow_surface_batched(
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    length_scale: FloatArray,
    seed: BoolArray,
    follows: BoolArray,
    knots: FloatArray,
    knot_length_scale: FloatArray,
    sigma_f: FloatArray,
    sigma_n: FloatArray,
    gate_noise: FloatArray,
    slope_std: float,
    growth: GrowthConfig,
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Do what `grow_surface_reference` does.

    What joins in a round is conditioned on at once: the covariance of all candidates
    given the inliers shrinks by one product, and nothing is factored twice.
    """
    n_segments = len(offsets) - 1
    inlier = np.zeros(len(r), dtype=np.bool_)
    mean = np.full((n_segments, len(knots)), np.nan)
    std = np.full((n_segments, len(knots)), np.nan)
    for segments in batches(offsets):
        own = Padded.of(segments, offsets)
        own_r, own_z, own_l = own.take(r), own.take(z), own.take(length_scale, 1.0)
        covariance = paciorek_batched(own_r, own_l, own_r, own_l, sigma_f[segments])
        covariance += slope_std**2 * own_r[:, :, None] * own_r[:, None, :]
        noise = np.broadcast_to(sigma_n[segments, None] ** 2, own_r.shape)
        gate = np.broadcast_to(gate_noise[segments, None] ** 2, own_r.shape)
        own_seed = seed[own.index] & own.mask
        own_follows = follows[own.index] & own.mask
        chosen = _grow(covariance, own_z, noise, gate, own.mask, own_seed, own_follows, growth)
        inlier[own.index[own.mask]] = chosen[own.mask]
        grown = chosen.any(axis=1)
        if len(knots) and grown.any():
            kept = segments[grown]
            wanted = np.broadcast_to(knots, (len(kept), len(knots)))
            is_wanted = np.isfinite(knot_length_scale[kept])
            wanted_l = np.where(is_wanted, knot_length_scale[kept], 1.0)
            cross = paciorek_batched(own_r[grown], own_l[grown], wanted, wanted_l, sigma_f[kept])
            cross += slope_std**2 * own_r[grown][:, :, None] * knots
            mean[kept], variance = _predict(
                regularised(covariance[grown], noise[grown], chosen[grown]),
                cross * chosen[grown][:, :, None],
                own_z[grown] * chosen[grown],
            )
            variance += sigma_f[kept, None] ** 2 + slope_std**2 * knots**2
            mean[kept] = np.where(is_wanted, mean[kept], np.nan)
            std[kept] = np.where(is_wanted, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    return inlier, mean, std


def _predict(
    covariance: FloatArray, cross: FloatArray, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Posterior mean, and what the data take from the prior variance (negative)."""
    solution = np.linalg.solve(covariance, np.concatenate([cross, z[:, :, None]], axis=2))
    mean = np.matmul(z[:, None, :], solution[:, :, :-1])[:, 0]
    return mean, -np.einsum('sik,sik->sk', cross, solution[:, :, :-1])


def _grow(
    prior: FloatArray,
    z: FloatArray,
    noise: FloatArray,
    gate: FloatArray,
    mask: BoolArray,
    seed: BoolArray,
    follows: BoolArray,
    growth: GrowthConfig,
) -> BoolArray:
    """Inliers of each segment, (S, n), for the prior covariance of its candidates."""
    chosen = np.zeros_like(seed)
    # Of the segments that still grow: which, and their state.
    active = np.flatnonzero(seed.any(axis=1))
    joining = seed[active]
    covariance, height = prior[active], np.zeros((len(active), seed.shape[1]))
    while len(active):
        chosen[active] |= joining
        height, covariance = _condition(covariance, height, z[active], noise[active], joining)
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        spread = np.sqrt(np.maximum(variance, 0.0) + gate[active])
        residual = (z[active] - height) / spread
        joining = (
            ~chosen[active]
            & mask[active]
            & (variance <= growth.max_std**2)
            & (residual <= growth.max_standardised_residual)
            & (residual >= -growth.max_standardised_depth)
        )
        following = follows[active] & ~chosen[active]
        following[:, 1:] &= chosen[active, :-1]
        joining |= following
        grows = joining.any(axis=1)
        active, joining = active[grows], joining[grows]
        covariance, height = covariance[grows], height[grows]
    return chosen


def _condition(
    covariance: FloatArray, height: FloatArray, z: FloatArray, noise: FloatArray, new: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Height and covariance of the candidates after observing those that are `new`."""
    # Places of the new ones, first in each row; the rest is padding.
    n_new = int(new.sum(axis=1).max())
    place = np.argsort(~new, axis=1, kind='stable')[:, :n_new]
    is_new = np.take_along_axis(new, place, axis=1)
    rows = np.take_along_axis(covariance, place[:, :, None], axis=1) * is_new[:, :, None]
    within = np.take_along_axis(rows, place[:, None, :], axis=2)
    regularised(within, np.take_along_axis(noise, place, axis=1), is_new)
    surprise = np.take_along_axis(z - height, place, axis=1) * is_new
    gain = np.linalg.solve(within, np.concatenate([rows, surprise[:, :, None]], axis=2))
    columns = np.swapaxes(rows, 1, 2)
    height = height + np.matmul(columns, gain[:, :, -1:])[:, :, 0]
    return height, covariance - np.matmul(columns, gain[:, :, :-1])
