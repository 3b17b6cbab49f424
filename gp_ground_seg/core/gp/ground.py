"""Stage 5: the observation process: inlier growth, and the surface of every segment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    FloatArray,
    Frame,
    GroundSurface,
    IntArray,
    Values,
)
from gp_ground_seg.core.gp.evidence import (
    STEP,
    Evidence,
    at_candidates,
    combined,
    combined_surface,
    contradicts,
    evidence_of_neighbours,
    seeds,
    uses_neighbours_in,
)
from gp_ground_seg.core.gp.kernels import (
    Padded,
    add_noise,
    batches,
    inverse_of_lower,
    paciorek,
    prior_variance,
    single_threaded_blas,
)
from gp_ground_seg.core.gp.latent import given_log_length_scales, latent_log_length_scales
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import Config, GrowthConfig


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

    With ``surface.look_aside`` one of `STEP` segments grows by itself first. Then all grow: the
    prediction is that of the segment and of those beside it together, and what stands above the
    latter alone neither starts the set nor joins it by a line (see
    `gp_ground_seg.core.gp.evidence`).
    The surface, too, is that of the segment and of those beside it together.

    Parameters
    ----------
    frame : Frame
        Candidates, lines, pseudo-inputs, knots.
    theta : (T,) float64
        Hyper-parameters of the frame (see `gp_ground_seg.core.gp.learning`).
    config : Config
        Model of the length-scale, prior slope, gates.

    Returns
    -------
    surface : GroundSurface
        Inliers; height and standard deviation at the knots.
    knot_log_length_scale : (M, K) float64
        At the knots [log m].
    log_length_scale : (C,) float64
        At the candidates [log m].
    """
    candidates, knots, slope_std = frame.candidates, frame.knots, config.observation.slope_std
    u, knot_u = log_length_scales(frame, theta, config)
    z = candidates.z - frame.prior_mean
    sill, gate_noise = variances_of(theta)
    largest = prior_variance(sill, slope_std, candidates.r.max(initial=0.0))
    gate_noise = max(gate_noise, ROUNDING * largest)
    noise = np.full(len(z), gate_noise)
    by_itself = SegmentSurfaces.empty(len(z), knot_u.shape)
    seed, odds = seeds(frame, theta, config)
    if config.label.rule == 'roughness':
        n_near = _count_near(candidates, np.exp(theta[3]))
        noise = noise_among(n_near, noise)
    else:
        odds = 0.0
    model = _Model(frame, sill, gate_noise, z, noise, np.exp(u), np.exp(knot_u), seed, odds)
    everywhere = np.arange(candidates.n_segments)
    uses_neighbours = uses_neighbours_in(frame, config)
    from_neighbours = Evidence(*np.zeros((2, len(z))))
    prior = prior_variance(sill, slope_std, knots)

    def evidence() -> Evidence:
        return evidence_of_neighbours(by_itself.mean, by_itself.std, prior, knots, slope_std)

    if uses_neighbours:
        _grow_segments(everywhere[::STEP], model, from_neighbours, config, by_itself)
        from_neighbours = at_candidates(evidence(), candidates, knots)
    _grow_segments(everywhere, model, from_neighbours, config, by_itself)
    mean, std = by_itself.mean, by_itself.std
    if uses_neighbours:
        mean, std = combined_surface(mean, std, prior, *evidence())
        mean[np.isnan(knot_u)] = std[np.isnan(knot_u)] = np.nan
    return GroundSurface(knots, mean + frame.prior_mean, std, by_itself.inlier), knot_u, u


def log_length_scales(
    frame: Frame, theta: FloatArray, config: Config
) -> tuple[FloatArray, FloatArray]:
    """Log length-scales by the model; returns as `latent_log_length_scales`."""
    if config.length_scale.model == 'latent':
        return latent_log_length_scales(frame, theta)
    return given_log_length_scales(frame, config.length_scale)


OBSTACLE_DEPTH = 1.0
"""Height over which the lowest returns of obstacles are spread [m]."""
ODDS_IN_FACE = 4.0
"""Least obstacles for each ground among the candidates in vertical faces."""
MOST_DOUBT = 30.0
"""Logarithm of odds that are as good as infinite."""


ROUNDING = 1e-12
"""Least noise of what is observed, in parts of the largest covariance: its rounding. With less, a
predicted variance could be negative."""


class SegmentSurfaces(NamedTuple):
    """The surface of each segment by itself."""

    inlier: BoolArray  # (C,) candidates that the surface rests on
    # (M, K) height about the prior mean and its standard deviation at the knots [m]; NaN where
    # there is none
    mean: FloatArray
    std: FloatArray

    @classmethod
    def empty(cls, n_candidates: int, shape: tuple[int, ...]) -> SegmentSurfaces:
        """No inlier, no surface."""
        none = np.zeros(n_candidates, dtype=np.bool_)
        return cls(none, *np.full((2, *shape), np.nan))


class _Model(NamedTuple):
    """Values that the segments grow from."""

    frame: Frame
    sill: float  # variance of the process [m^2]
    gate_noise: float  # variance of the noise of a single candidate [m^2]
    z: FloatArray  # (C,) about the prior mean [m]
    # (C,) variance of the noise with which a candidate is observed, unless it joins in doubt
    noise: FloatArray
    length_scale: FloatArray  # (C,) at the candidates [m]
    knot_length_scale: FloatArray  # (M, K) at the knots [m]
    seed: BoolArray  # (C,) candidates that start the inlier set
    odds: float  # obstacles for each ground among the candidates; 0: none joins in doubt


@shared
def fits(
    z: Values, height: Values, variance: Values, noise: Values, growth: GrowthConfig
) -> Values:
    """Whether heights are predicted well enough, and near enough, to join."""
    residual = z - height
    limit = choose(residual > 0.0, growth.max_standardised_residual, growth.max_standardised_depth)
    is_near = residual * residual <= limit * limit * (variance + noise)
    return (variance <= growth.max_std * growth.max_std) & is_near


@shared
def variances_of(theta: Values) -> tuple[Values, Values]:
    """Variances of the process and of its noise by theta [m^2]."""
    return np.exp(2.0 * theta[0]), np.exp(2.0 * theta[1])


@shared
def noise_among(n: Values, noise: Values) -> Values:
    """Variance of the noise with which one of `n` candidates close together is observed [m^2].

    Close together is within sigma_l_bar, the distance over which the latent process takes the
    ground for alike. There a bump or a wrong length-scale moves all candidates alike: together
    they show as much as one. `noise` is the variance of a single candidate, which the gate uses.
    """
    return n * noise


def _count_near(candidates: Candidates, reach: float) -> IntArray:
    """Count the candidates of its segment within `reach` [m] of each, itself as well."""
    r, segment = candidates.r, candidates.segment
    number = np.ones(len(r), dtype=np.int64)
    for n in range(1, len(r)):
        is_near = (r[n:] - r[:-n] <= reach) & (segment[n:] == segment[:-n])
        if not is_near.any():
            break
        number[n:] += is_near
        number[:-n] += is_near
    return number


def posterior_covariance(
    frame: Frame, theta: FloatArray, config: Config, surface: GroundSurface, m: int
) -> FloatArray:
    """Covariance of the heights of segment m at its first n knots, (n, n) [m^2].

    n knots of the segment have a height. Correlations are those of its own process given its
    inliers (paper, eq. 7), variances those of `surface`: its neighbours make these smaller, and
    doubt of an inlier larger.
    """
    candidates, n = frame.candidates, int(np.isfinite(surface.mean[m]).sum())
    own = np.flatnonzero(surface.inlier & (candidates.segment == m))
    u, knot_u = log_length_scales(frame, theta, config)
    r = np.concatenate([candidates.r[own], frame.knots[:n]])
    l = np.exp(np.concatenate([u[own], knot_u[m, :n]]))  # noqa: E741
    sill, noise = variances_of(theta)
    prior = paciorek(r[:, None], l[:, None], r, l, sill)
    prior += config.observation.slope_std**2 * np.outer(r, r)
    if config.label.rule == 'roughness':
        noise = noise_among(_count_near(candidates, np.exp(theta[3]))[own], noise)
    given, cross = prior[: len(own), : len(own)] + np.eye(len(own)) * noise, prior[: len(own)]
    cov = prior - cross.T @ np.linalg.solve(given, cross)
    cov = cov[len(own) :, len(own) :]
    scale = surface.std[m, :n] / np.sqrt(np.diag(cov))
    result: FloatArray = cov * np.outer(scale, scale)
    return result


@shared
def noise_in_doubt(
    z: Values, height: Values, variance: Values, noise: Values, in_face: Values, odds: Values
) -> Values:
    """Variance of the noise of a candidate that joins, which may be an obstacle [m^2].

    As for the labels, ground and obstacle are compared: the heights of the one are distributed by
    the prediction, those of the other evenly over `OBSTACLE_DEPTH`; `odds` are the obstacles for
    each ground in the frame. With this noise the variance
    of the prediction shrinks by the probability of ground times what certain ground would take
    from it: a candidate in doubt shows little (probabilistic data association). Obstacles stand
    above the ground, so there is no doubt below.
    """
    residual, spread = z - height, variance + noise
    odds = choose(in_face, np.maximum(odds, ODDS_IN_FACE), odds)
    density = np.sqrt(2.0 * np.pi * spread) / OBSTACLE_DEPTH
    doubt = odds * density * np.exp(np.minimum(0.5 * residual * residual / spread, MOST_DOUBT))
    return noise + choose(residual > 0.0, doubt * spread, 0.0)


def _grow_segments(
    segments: IntArray,
    model: _Model,
    from_neighbours: Evidence,
    config: Config,
    by_itself: SegmentSurfaces,
) -> None:
    """Inliers and surface of `segments`, into `by_itself`, with the evidence at candidates."""
    by_itself.mean[segments] = by_itself.std[segments] = np.nan
    offsets = model.frame.candidates.offsets
    is_below = ~contradicts(*from_neighbours, model.z, model.gate_noise)
    continues_line = model.frame.continues_line & is_below
    model = model._replace(
        frame=model.frame._replace(continues_line=continues_line), seed=model.seed & is_below
    )
    size = offsets[segments + 1] - offsets[segments]
    for batch in batches(np.concatenate([[0], np.cumsum(size)])):
        _grow_batch(segments[batch], model, from_neighbours, config, by_itself)


def _grow_batch(
    segments: IntArray,
    model: _Model,
    from_neighbours: Evidence,
    config: Config,
    by_itself: SegmentSurfaces,
) -> None:
    frame, slope_std = model.frame, config.observation.slope_std
    layout = Padded.of(segments, frame.candidates.offsets)
    r = layout.take(frame.candidates.r)
    is_wanted = np.isfinite(model.knot_length_scale[segments])
    n_knots = int(is_wanted.sum(axis=1).max())
    is_wanted = is_wanted[:, :n_knots]
    knots = np.broadcast_to(frame.knots[:n_knots], is_wanted.shape)
    knot_l = np.where(is_wanted, model.knot_length_scale[segments, :n_knots], 1.0)
    batch = _Batch(
        np.concatenate([r, knots], axis=1),
        np.concatenate([layout.take(model.length_scale, 1.0), knot_l], axis=1),
        model.sill,
        slope_std,
        layout.take(model.z),
        model.gate_noise,
        layout.take(model.noise),
        layout.mask,
        model.seed[layout.place] & layout.mask,
        frame.continues_line[layout.place] & layout.mask,
        frame.in_face[layout.place],
        Evidence(layout.take(from_neighbours.height), layout.take(from_neighbours.precision)),
    )
    chosen, height, variance = _grow(batch, config.growth, model.odds)
    by_itself.inlier[layout.place[layout.mask]] = chosen[layout.mask]
    is_known = is_wanted & chosen.any(axis=1, keepdims=True)
    n = chosen.shape[1]
    std = np.sqrt(np.maximum(variance[:, n:], 0.0))
    by_itself.mean[segments, :n_knots] = np.where(is_known, height[:, n:], np.nan)
    by_itself.std[segments, :n_knots] = np.where(is_known, std, np.nan)


class _Batch(NamedTuple):
    """Candidates of S segments, padded to n, and the knots behind them: N places in all."""

    r: FloatArray  # (S, N)
    length_scale: FloatArray  # (S, N)
    sill: float
    slope_std: float
    z: FloatArray  # (S, n) about the prior mean
    gate_noise: float  # variance of the noise of a candidate
    # (S, n) variance of that with which it is observed; grows where it joins in doubt
    noise: FloatArray
    mask: BoolArray  # (S, n)
    seed: BoolArray  # (S, n)
    continues_line: BoolArray  # (S, n)
    in_face: BoolArray  # (S, n)
    from_neighbours: Evidence  # (S, n)


@np.errstate(over='ignore')  # the square of 1e200 m: no fit
def _grow(
    batch: _Batch, growth: GrowthConfig, odds: float
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Inliers of each segment, (S, n), and height and variance at all places, (S, N).

    The noise of the inliers is set, see `noise_in_doubt`, unless `odds` are 0. Candidates that
    join in a round are conditioned on at once: their rows of ``L^-1 K(inliers, all places)`` are
    appended to those of the rounds before, and nothing is factored twice.
    """
    n_segments, n = batch.seed.shape
    chosen = np.zeros_like(batch.seed)
    height, variance = np.zeros_like(batch.r), prior_variance(batch.sill, batch.slope_std, batch.r)
    # Segments that still grow, and the whitened rows of their inliers.
    active, joining = np.arange(n_segments), batch.seed
    whitened = np.empty((n_segments, 0, variance.shape[1]))
    if odds > 0.0:
        predicted = combined(0.0, variance[:, :n], *batch.from_neighbours)
        doubtful = noise_in_doubt(batch.z, *predicted, batch.noise, True, odds)
        batch.noise[:] = np.where(joining & batch.in_face, doubtful, batch.noise)
    while len(active):
        chosen |= joining
        if joining.any():
            whitened = _condition(batch, active, joining[active], whitened, height, variance)
        following = np.zeros_like(chosen)
        following[:, 1:] = batch.continues_line[:, 1:] & chosen[:, :-1]
        predicted = combined(height[:, :n], variance[:, :n], *batch.from_neighbours)
        joining = fits(batch.z, *predicted, batch.gate_noise, growth) | following
        joining &= ~chosen & batch.mask
        # Before anything has joined, only the evidence of neighbours decides.
        joining &= chosen.any(axis=1, keepdims=True) | (batch.from_neighbours.precision > 0.0)
        if odds > 0.0:
            doubtful = noise_in_doubt(batch.z, *predicted, batch.noise, batch.in_face, odds)
            batch.noise[:] = np.where(joining & ~following, doubtful, batch.noise)
        grows = joining[active].any(axis=1)
        active, whitened = active[grows], whitened[grows]
    return chosen, height, variance


def _prior_rows(batch: _Batch, segment: IntArray, place: IntArray) -> FloatArray:
    """Prior covariance of places (P,), of segments (P,), with all places, (P, N)."""
    r, length_scale = batch.r[segment], batch.length_scale[segment]
    own_r, own_l = batch.r[segment, place][:, None], batch.length_scale[segment, place][:, None]
    rows: FloatArray = paciorek(own_r, own_l, r, length_scale, batch.sill)
    rows += batch.slope_std**2 * own_r * r
    return rows


def _condition(
    batch: _Batch,
    active: IntArray,
    new: BoolArray,
    whitened: FloatArray,
    height: FloatArray,
    variance: FloatArray,
) -> FloatArray:
    """Change height and variance of segments by observing those that are `new`.

    Returns their rows, (A, m + n_new, N), behind those `whitened`, (A, m, N).
    """
    # Places of the new ones, first in each row; the rest is padding.
    own, segment, n_new = np.arange(len(new))[:, None], active[:, None], new.sum(axis=1)
    place = np.argsort(~new, axis=1, kind='stable')[:, : n_new.max()]
    is_new = np.arange(place.shape[1]) < n_new[:, None]
    which, rank = np.nonzero(is_new)
    rows = np.zeros((*place.shape, batch.r.shape[1]))
    rows[which, rank] = _prior_rows(batch, active[which], place[which, rank])
    if whitened.size:
        rows -= np.matmul(whitened[own, :, place], whitened)
    within = rows[own, :, place]
    add_noise(within, batch.noise[segment, place], is_new)
    unit = inverse_of_lower(np.linalg.cholesky(within)) * is_new[:, :, None]
    rows = np.matmul(unit, rows)
    innovation = batch.z[segment, place] - height[segment, place]
    innovation = np.matmul(unit, innovation[:, :, None])
    height[active] += np.matmul(innovation.swapaxes(1, 2), rows)[:, 0]
    variance[active] -= np.einsum('sij,sij->sj', rows, rows)
    return np.concatenate([whitened, rows], axis=1)
