"""Stage 5b: the observation process: inlier growth, and the surface of every segment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gp_ground_seg.frame import BoolArray, FloatArray, Frame, GroundSurface
from gp_ground_seg.gp.kernels import paciorek
from gp_ground_seg.gp.latent import given_log_length_scales, latent_log_length_scales
from gp_ground_seg.gp.linalg import Padded, add_noise, batches, single_threaded_blas
from gp_ground_seg.parameters.config import Config, GrowthConfig


@single_threaded_blas()
def estimate_surface(
    frame: Frame, theta: FloatArray, config: Config
) -> tuple[GroundSurface, FloatArray, FloatArray]:
    """Inliers that grow from low, near candidates, and the surface that rests on them.

    A candidate joins when the predictive standard deviation is at most
    ``growth.max_std`` and its standardised residual is at most
    ``growth.max_standardised_residual`` above the prediction, or
    ``growth.max_standardised_depth`` below; or when it continues the line of an inlier.
    This repeats until none joins (GP-INSAC of Chen et al. 2014; the paper's outlier
    rejection). The gate is asymmetric because obstacles stand only above the ground. The
    height and variance of the surface are the paper's eqs. 6 and 7.

    Parameters
    ----------
    frame : Frame
        Candidates, lines, pseudo-inputs, knots.
    theta : (M, 6) float64
        Hyper-parameters of each segment (see `gp_ground_seg.gp.learning`).
    config : Config
        Model of the length-scale, prior slope, gates, neighbours to fuse.

    Returns
    -------
    surface : GroundSurface
        Inliers; height and standard deviation at the knots, fused with the neighbours'.
    knot_log_length_scale : (M, K) float64
        At the knots [log m].
    log_length_scale : (C,) float64
        At the candidates [log m]; may lie in a buffer that the next call reuses.
    """
    candidates, growth, slope_std = frame.candidates, config.growth, config.observation.slope_std
    if config.length_scale.model == 'latent':
        u, knot_u = latent_log_length_scales(frame, theta)
    else:
        u, knot_u = given_log_length_scales(frame, config.length_scale)
    z = candidates.z - frame.prior_mean
    seed = (candidates.r <= growth.seed_range) & (np.abs(z) <= growth.seed_height_tolerance)
    sigma_f, sigma_n = np.exp(theta[:, :2]).T
    length_scale, knot_l = np.exp(u), np.exp(knot_u)

    inlier = np.zeros(len(z), dtype=np.bool_)
    mean, std = np.full((2, *knot_l.shape), np.nan)
    for segments in batches(candidates.offsets):
        own = Padded.of(segments, candidates.offsets)
        r, own_z, own_l = own.take(candidates.r), own.take(z), own.take(length_scale, 1.0)
        covariance = paciorek(r, own_l, r, own_l, sigma_f[segments])
        covariance += slope_std**2 * r[:, :, None] * r[:, None, :]
        noise = np.broadcast_to(sigma_n[segments, None] ** 2, r.shape)
        batch = _Batch(
            covariance,
            own_z,
            noise,
            own.mask,
            seed[own.place] & own.mask,
            frame.continues_line[own.place] & own.mask,
        )
        chosen = _grow(batch, growth)
        inlier[own.place[own.mask]] = chosen[own.mask]
        grown = chosen.any(axis=1)
        if len(frame.knots) == 0 or not grown.any():
            continue
        kept = segments[grown]
        knots = np.broadcast_to(frame.knots, (len(kept), len(frame.knots)))
        is_wanted = np.isfinite(knot_l[kept])
        wanted_l = np.where(is_wanted, knot_l[kept], 1.0)
        cross = paciorek(r[grown], own_l[grown], knots, wanted_l, sigma_f[kept])
        cross += slope_std**2 * r[grown][:, :, None] * frame.knots
        mean[kept], variance = _predict(
            add_noise(covariance[grown], noise[grown], chosen[grown]),
            cross * chosen[grown][:, :, None],
            own_z[grown] * chosen[grown],
        )
        variance += sigma_f[kept, None] ** 2 + slope_std**2 * frame.knots**2
        mean[kept] = np.where(is_wanted, mean[kept], np.nan)
        std[kept] = np.where(is_wanted, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    mean, std = fuse_neighbours(mean, std, frame.knots, config.surface.n_neighbours, slope_std)
    return GroundSurface(frame.knots, mean + frame.prior_mean, std, inlier), knot_u, u


class _Batch(NamedTuple):
    """Candidates of S segments, padded to n."""

    covariance: FloatArray  # (S, n, n) prior
    z: FloatArray  # (S, n) about the prior mean
    noise: FloatArray  # (S, n) variance
    mask: BoolArray  # (S, n)
    seed: BoolArray  # (S, n)
    continues_line: BoolArray  # (S, n)


def _predict(
    covariance: FloatArray, cross: FloatArray, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Posterior mean, and the (negative) change of the prior variance by the data."""
    solution = np.linalg.solve(covariance, np.concatenate([cross, z[:, :, None]], axis=2))
    mean = np.matmul(z[:, None, :], solution[:, :, :-1])[:, 0]
    return mean, -np.einsum('sik,sik->sk', cross, solution[:, :, :-1])


def _grow(batch: _Batch, growth: GrowthConfig) -> BoolArray:
    """Inliers of each segment, (S, n).

    Candidates that join in a round are conditioned on at once: the covariance of all
    candidates given the inliers shrinks by one product, and nothing is factored twice.
    """
    chosen = np.zeros_like(batch.seed)
    # Segments that still grow, and their state.
    active = np.flatnonzero(batch.seed.any(axis=1))
    joining = batch.seed[active]
    covariance, height = batch.covariance[active], np.zeros(joining.shape)
    while len(active):
        chosen[active] |= joining
        z = batch.z[active]
        height, covariance = _condition(covariance, height, z, batch.noise[active], joining)
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        spread = np.sqrt(np.maximum(variance, 0.0) + batch.noise[active])
        residual = (z - height) / spread
        joining = (
            ~chosen[active]
            & batch.mask[active]
            & (variance <= growth.max_std**2)
            & (residual <= growth.max_standardised_residual)
            & (residual >= -growth.max_standardised_depth)
        )
        following = batch.continues_line[active] & ~chosen[active]
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
    add_noise(within, np.take_along_axis(noise, place, axis=1), is_new)
    innovation = np.take_along_axis(z - height, place, axis=1) * is_new
    gain = np.linalg.solve(within, np.concatenate([rows, innovation[:, :, None]], axis=2))
    columns = np.swapaxes(rows, 1, 2)
    height = height + np.matmul(columns, gain[:, :, -1:])[:, :, 0]
    return height, covariance - np.matmul(columns, gain[:, :, :-1])


def fuse_neighbours(
    mean: FloatArray, std: FloatArray, knots: FloatArray, n_neighbours: int, slope_std: float
) -> tuple[FloatArray, FloatArray]:
    """Fuse each segment's surface with those of its neighbours.

    The surface of the segment k steps aside predicts this one with the variance
    ``std^2 + (slope_std s_k)^2``, where ``s_k`` is the arc between the two at the
    knot's range: the same prior slope as along the range. The predictions are
    weighted by their inverse variances. A segment without a model gets one from
    its neighbours, if they have any.

    Parameters
    ----------
    mean, std : (M, K) float64
        Height and standard deviation at the knots [m]; NaN from the first knot on
        where there is no model.
    knots : (K,) float64
        Ranges of the knots [m].
    n_neighbours : int
        Segments on either side.
    slope_std : float
        Standard deviation of the ground's slope.

    Returns
    -------
    mean, std : (M, K) float64
        Fused height and standard deviation [m].
    """
    if n_neighbours == 0:
        return mean, std
    step = 2.0 * np.pi / len(mean)
    total_weight = np.zeros_like(mean)
    weighted = np.zeros_like(mean)
    for k in range(-n_neighbours, n_neighbours + 1):
        variance = np.roll(std, k, axis=0) ** 2 + (slope_std * abs(k) * step * knots) ** 2
        known = np.isfinite(variance)
        # Standard deviations below a tenth of a millimetre count as that.
        weight = np.where(known, 1.0 / np.maximum(np.where(known, variance, 1.0), 1e-8), 0.0)
        total_weight += weight
        weighted += weight * np.where(known, np.roll(mean, k, axis=0), 0.0)
    known = total_weight > 0.0
    safe = np.where(known, total_weight, 1.0)
    return np.where(known, weighted / safe, np.nan), np.where(known, 1.0 / np.sqrt(safe), np.nan)
