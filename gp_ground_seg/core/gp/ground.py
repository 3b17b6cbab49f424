"""Stage 5: the observation process: inlier growth, and the surface of every segment."""

import math
from collections.abc import Callable
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
    contradicts,
    evidence_of_neighbours,
    find_seeds,
    join_evidence,
)
from gp_ground_seg.core.gp.kernels import (
    Padded,
    add_noise,
    batches,
    inverse_of_lower,
    line_covariance,
    line_variances,
    paciorek,
    prior_variance,
    single_threaded_blas,
)
from gp_ground_seg.core.gp.latent import (
    given_log_length_scales,
    given_theta,
    latent_log_length_scales,
)
from gp_ground_seg.core.gp.model import Model, SegmentSurfaces
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import Config, GrowthConfig, ObservationConfig
from gp_ground_seg.core.pipeline.lines import is_walkable


def estimate_surface(
    frame: Frame,
    theta: FloatArray,
    config: Config,
    fit: Callable[..., None] | None = None,
) -> tuple[GroundSurface, FloatArray, FloatArray]:
    """Inliers that grow from low, near candidates, and the surface that rests on them.

    The inliers grow under the values of theta that the configuration gives (see `grow_inliers`).
    The surface is the regression on them under `theta`: what is learned from inliers does not
    choose them. Its height and variance are the paper's eqs. 6 and 7.

    Parameters
    ----------
    frame : Frame
        Candidates, lines, pseudo-inputs, knots.
    theta : (T,) float64
        Hyper-parameters of the frame (see `gp_ground_seg.core.gp.learning`).
    config : Config
        Model of the length-scale, prior of the line, gates.
    fit : callable, optional
        `fit_surfaces`, compiled.

    Returns
    -------
    surface : GroundSurface
        Inliers; height and standard deviation at the knots.
    knot_log_length_scale : (M, K) float64
        At the knots [log m].
    log_length_scale : (C,) float64
        At the candidates [log m].
    """
    found = SegmentSurfaces.to_be_set(frame, config)
    (fit or single_threaded_blas()(fit_surfaces))(
        frame, given_theta(config), theta, Model.of(frame, config), found
    )
    surface = GroundSurface(frame.knots, found.mean, found.std, found.inlier)
    return surface, found.knot_log_length_scale, found.log_length_scale


@shared
def fit_surfaces(
    frame: Frame, given: FloatArray, theta: FloatArray, model: Model, found: SegmentSurfaces
) -> None:
    """Set the inliers and surfaces of all segments; `given` (T,) is `given_theta`.

    Where neighbours are used, one of `STEP` segments grows by itself first. Then all grow: the
    prediction is that of the segment and of those beside it together, and what stands above the
    latter alone does not start the set (see `gp_ground_seg.core.gp.evidence`). The surface, too,
    is that of the segment and of those beside it together.
    """
    knots, observation, mean, std = frame.knots, model.observation, found.mean, found.std
    u, knot_u = found.log_length_scale, found.knot_log_length_scale
    if model.is_latent:
        latent_log_length_scales(frame, given, 1, u, knot_u)
    from_neighbours = Evidence(np.empty((0, 0)), np.empty((0, 0)))
    if model.uses_neighbours:
        find_seeds(frame, given, observation.slope_std, found.seed)
        grow_inliers(frame, given, model, from_neighbours, STEP, found)
        regress(frame, given, observation, STEP, found)
        from_neighbours = evidence_of_neighbours(mean, std, knots, given, observation)
    grow_inliers(frame, given, model, from_neighbours, 1, found)
    if model.is_latent and (theta[2:] != given[2:]).any():
        latent_log_length_scales(frame, theta, 1, u, knot_u)
    regress(frame, theta, observation, 1, found)
    if model.uses_neighbours:
        from_neighbours = evidence_of_neighbours(mean, std, knots, theta, observation)
        join_evidence(found, from_neighbours, knots, theta, observation)
    mean += frame.prior_mean


OBSTACLE_DEPTH = 1.0
"""Height over which the lowest returns of obstacles are spread [m]."""
ODDS, ODDS_IN_FACE = 0.25, 4.0
"""Odds that a candidate is an obstacle, and that one in a vertical face is."""
MOST_DOUBT = 30.0
"""Logarithm of odds that are as good as infinite."""
ROUNDING, ROUNDING_SINGLE = 1e-12, 1e-6
"""Least noise of what is observed, in parts of the largest covariance: its rounding, in double and
in single precision. With less, a predicted variance could be negative."""
RISES_ON = 0.8
"""Part of the slope to a candidate with which the ground behind it must rise on."""


@shared
def fits(
    z: Values, height: Values, variance: Values, noise: Values, growth: GrowthConfig
) -> Values:
    """Whether heights are predicted well enough, and near enough, to join."""
    residual, limit = z - height, growth.max_standardised_residual
    is_near = residual * residual <= limit * limit * (variance + noise)
    return (np.minimum(variance, residual * residual) <= growth.max_std * growth.max_std) & is_near


@shared
def variances_of(
    frame: Frame, theta: FloatArray, observation: ObservationConfig, least: float
) -> tuple[float, float]:
    """Variances of the process and of its noise by theta [m^2].

    That of the noise is at least the rounding of covariances, `least` of the largest.
    """
    sill, noise, r = math.exp(2.0 * theta[0]), math.exp(2.0 * theta[1]), frame.candidates.r
    farthest = r.max() if len(r) > 0 else 0.0
    return sill, max(noise, least * prior_variance(sill, observation, farthest))


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
    u, knot_u = given_log_length_scales(frame, config.length_scale)
    if config.length_scale.model == 'latent':
        latent_log_length_scales(frame, theta, 1, u, knot_u)
    r = np.concatenate([candidates.r[own], frame.knots[:n]])
    l = np.exp(np.concatenate([u[own], knot_u[m, :n]]))  # noqa: E741
    sill, noise = variances_of(frame, theta, config.observation, ROUNDING)
    prior = paciorek(r[:, None], l[:, None], r, l, sill)
    prior += line_covariance(r[:, None], r, *line_variances(config.observation))
    reach = np.exp(given_theta(config)[3]) if config.label.rule == 'roughness' else 0.0
    noises = noise_among(_count_near(candidates, reach)[own], noise)
    given, cross = prior[: len(own), : len(own)] + np.diag(noises), prior[: len(own), len(own) :]
    cov = prior[len(own) :, len(own) :] - cross.T @ np.linalg.solve(given, cross)
    scale = surface.std[m, :n] / np.sqrt(np.diag(cov))
    result: FloatArray = cov * np.outer(scale, scale)
    return result


@shared
def noise_in_doubt(
    z: Values, height: Values, variance: Values, noise: Values, in_face: Values
) -> Values:
    """Variance of the noise of a candidate that joins, which may be an obstacle [m^2].

    As for the labels, ground and obstacle are compared: the heights of the one are distributed by
    the prediction, those of the other evenly over `OBSTACLE_DEPTH`, at the odds above. With this
    noise the variance of the prediction shrinks by the probability of ground times what certain
    ground would take from it: a candidate in doubt shows little (probabilistic data association).
    Obstacles stand above the ground, so there is no doubt below.
    """
    residual, spread = z - height, variance + noise
    odds = choose(in_face, ODDS_IN_FACE, ODDS)
    density = np.sqrt(2.0 * np.pi * spread) / OBSTACLE_DEPTH
    doubt = odds * density * np.exp(np.minimum(0.5 * residual * residual / spread, MOST_DOUBT))
    return noise + choose(residual > 0.0, doubt * spread, 0.0)


def grow_inliers(
    frame: Frame,
    theta: FloatArray,
    model: Model,
    from_neighbours: Evidence,
    step: int,
    found: SegmentSurfaces,
) -> None:
    """Let the inliers of every `step`-th segment grow from seeds, in `found`, under `theta`.

    A candidate joins when the predictive standard deviation, or the residual, is at most
    ``growth.max_std``, and the standardised residual at most
    ``growth.max_standardised_residual``; or when the ground carries on to it from the inlier
    before (see `carries_on`). This repeats until none joins (GP-INSAC of Chen et al. 2014; the
    paper's outlier rejection).

    `from_neighbours` is the evidence of the segments beside each. If ``label.rule`` is roughness,
    a candidate among others, or that joins in doubt, shows less: see `noise_among` and
    `noise_in_doubt`. Where the ground carries on to it there is no doubt.
    """
    candidates, z = frame.candidates, frame.candidates.z - frame.prior_mean
    sill, gate_noise = variances_of(frame, theta, model.observation, ROUNDING_SINGLE)
    found.alike[:] = _count_near(candidates, np.exp(theta[3]) if model.by_roughness else 0.0)
    noise, beside = noise_among(found.alike, gate_noise), at_candidates(from_neighbours, frame)
    above = contradicts(*beside, z, gate_noise)
    lines = frame.lines
    extent = candidates.r - candidates.r[lines.start[lines.line]]
    found.inlier[:], found.doubt[:] = False, 0.0
    for segments in batches(np.arange(0, candidates.n_segments, step), candidates.offsets):
        layout = Padded.of(segments, candidates.offsets)
        place, mask = layout.place, layout.mask
        state = _Batch(
            layout.take(candidates.r).astype(np.float32),
            np.exp(layout.take(found.log_length_scale)).astype(np.float32),
            sill,
            model.observation,
            layout.take(z),
            gate_noise,
            layout.take(noise),
            mask,
            (found.seed & ~above)[place] & mask,
            layout.take(frame.onward, -np.inf),
            lines.slope[lines.line[place]],
            extent[place],
            frame.in_face[place],
            above[place],
            Evidence(layout.take(beside.height), layout.take(beside.precision)),
        )
        chosen = _grow(state, model)
        found.inlier[place[mask]] = chosen[mask]
        found.doubt[place[mask]] = state.noise[mask] - noise[place[mask]]


class _Batch(NamedTuple):
    """Candidates of S segments, padded to n."""

    r: FloatArray  # (S, n)
    length_scale: FloatArray  # (S, n)
    sill: float
    observation: ObservationConfig
    z: FloatArray  # (S, n) about the prior mean
    gate_noise: float  # variance of the noise of a candidate
    # (S, n) variance of that with which it is observed; grows where it joins in doubt
    noise: FloatArray
    mask: BoolArray  # (S, n)
    seed: BoolArray  # (S, n)
    onward: FloatArray  # (S, n)
    slope: FloatArray  # (S, n) that of its line
    extent: FloatArray  # (S, n) how far its line reaches back
    in_face: BoolArray  # (S, n)
    above: BoolArray  # (S, n) the evidence contradicts it
    from_neighbours: Evidence  # (S, n)


@np.errstate(over='ignore', invalid='ignore')  # the square of 1e200 m: no fit; -inf times 0
def _grow(batch: _Batch, model: Model) -> BoolArray:
    """Inliers of each segment, (S, n).

    If ``label.rule`` is roughness, doubt changes their noise (see `noise_in_doubt`). Candidates
    that join in a round are conditioned on at once: their rows of ``L^-1 K(inliers, candidates)``
    are appended to those of the rounds before, and nothing is factored twice.
    """
    chosen = np.zeros_like(batch.seed)
    variance = prior_variance(batch.sill, batch.observation, batch.r)
    height = np.zeros_like(batch.r)
    # Segments that still grow, and the whitened rows of their inliers.
    active, joining = np.arange(len(chosen)), batch.seed
    whitened = np.empty((len(chosen), 0, variance.shape[1]), variance.dtype)
    if model.by_roughness:
        predicted = combined(0.0, variance, *batch.from_neighbours)
        doubtful = noise_in_doubt(batch.z, *predicted, batch.noise, True)
        batch.noise[:] = np.where(joining & batch.in_face, doubtful, batch.noise)
    while len(active):
        chosen |= joining
        if joining.any():
            whitened = _condition(batch, active, joining[active], whitened, height, variance)
        predicted = combined(height, variance, *batch.from_neighbours)
        fitting = fits(batch.z, *predicted, batch.gate_noise, model.growth)
        # Before anything has joined, only the evidence of neighbours decides.
        may_join = ~chosen & batch.mask
        may_join &= chosen.any(axis=1, keepdims=True) | (batch.from_neighbours.precision > 0.0)
        on_slope, is_shown = _on_slope(batch, chosen, fitting, model.growth)
        if model.by_roughness:
            doubtful = noise_in_doubt(batch.z, *predicted, batch.noise, batch.in_face)
            batch.noise[:] = np.where(may_join & fitting & ~is_shown, doubtful, batch.noise)
        joining = may_join & (fitting | on_slope)
        grows = joining[active].any(axis=1)
        active, whitened = active[grows], whitened[grows]
    return chosen


def _on_slope(
    batch: _Batch, chosen: BoolArray, fitting: BoolArray, growth: GrowthConfig
) -> tuple[BoolArray, BoolArray]:
    """Candidates to which the ground goes on from the last of those `chosen`, (S, n).

    Of the second ones the returns behind or before them show that it rises. Behind one that stands
    on it, or is in a face, it does not go on, until the next that is chosen.
    """
    own, place = np.arange(len(chosen))[:, None], np.arange(chosen.shape[1])

    def last(marked: BoolArray) -> IntArray:
        """Place of the last one `marked` before each, -1 if none."""
        found = np.maximum.accumulate(np.where(marked, place, -1), axis=1)
        return np.concatenate([np.full((len(found), 1), -1), found[:, :-1]], axis=1)

    before = last(chosen)
    rise, distance = (values - values[own, before] for values in (batch.z, batch.r))
    walkable = is_walkable(rise, distance, growth.max_slope) & ~batch.in_face & ~batch.above
    is_open = walkable & (before >= 0) & (last(~chosen & ~fitting & ~walkable) < before)
    slope = slope_before(batch.slope[own, before], batch.extent[own, before], distance, growth)
    is_shown = is_open & carries_on(rise, distance, batch.onward, slope)
    return is_shown | (is_open & (rise <= 0.0)), is_shown


@shared
def carries_on(rise: Values, distance: Values, onward: Values, before: Values) -> Values:
    """Whether the ground is seen to go on as it rises by so much [m] over a distance [m].

    `onward` is the slope behind: where it is less, the ground has come to an object. At the end of
    a segment (NaN) it is `before`, see `slope_before`.
    """
    slope = choose(np.isnan(onward), before, onward)
    return (rise > 0.0) & (RISES_ON * rise <= slope * distance)


@shared
def slope_before(slope: Values, extent: Values, distance: Values, growth: GrowthConfig) -> Values:
    """Slope of a line as far as it tells that of the ground at a distance before it, or NaN.

    That is not farther than the line reaches back, its `extent` [m].
    """
    is_long = (extent >= growth.min_rise_extent) & (extent >= distance)
    return choose(is_long, slope, np.nan)


def _rows(batch: _Batch, segment: IntArray, place: IntArray) -> FloatArray:
    """Prior covariance of places (P,), of segments (P,), with all places, (P, n)."""
    r, length_scale = batch.r[segment], batch.length_scale[segment]
    own_r, own_l = batch.r[segment, place][:, None], batch.length_scale[segment, place][:, None]
    rows: FloatArray = paciorek(own_r, own_l, r, length_scale, batch.sill)
    rows += line_covariance(own_r, r, *line_variances(batch.observation))
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

    Returns their rows, (A, m + n_new, n), behind those `whitened`, (A, m, n).
    """
    # Places of the new ones, first in each row; the rest is padding.
    own, segment, n_new = np.arange(len(new))[:, None], active[:, None], new.sum(axis=1)
    place = np.argsort(~new, axis=1, kind='stable')[:, : n_new.max()]
    is_new = np.arange(place.shape[1]) < n_new[:, None]
    which, rank = np.nonzero(is_new)
    rows = np.zeros((*place.shape, batch.r.shape[1]), batch.r.dtype)
    rows[which, rank] = _rows(batch, active[which], place[which, rank])
    if whitened.size:
        rows -= np.matmul(whitened[own, :, place], whitened)
    within = rows[own, :, place]
    add_noise(within, batch.noise[segment, place], is_new)
    unit = inverse_of_lower(np.linalg.cholesky(within)) * is_new[:, :, None]
    rows = np.matmul(unit, rows)
    innovation = batch.z[segment, place] - height[segment, place]
    innovation = np.matmul(unit, innovation[:, :, None].astype(unit.dtype))
    height[active] += np.matmul(innovation.swapaxes(1, 2), rows)[:, 0]
    variance[active] -= np.einsum('sij,sij->sj', rows, rows)
    return np.concatenate([whitened, rows], axis=1)


def regress(
    frame: Frame,
    theta: FloatArray,
    observation: ObservationConfig,
    step: int,
    found: SegmentSurfaces,
) -> None:
    """Surface of every `step`-th segment by its own inliers and `theta`, into `found`."""
    candidates, knot_u = frame.candidates, found.knot_log_length_scale
    which = np.flatnonzero(found.inlier)
    segments = np.arange(0, candidates.n_segments, step)
    sill, noise = variances_of(frame, theta, observation, ROUNDING)
    line = line_variances(observation)
    noise = (noise_among(found.alike, noise) + found.doubt)[which]
    r, z = candidates.r[which], candidates.z[which] - frame.prior_mean
    length_scale = np.exp(found.log_length_scale[which])
    offsets = np.searchsorted(which, candidates.offsets)
    found.mean[segments] = found.std[segments] = np.nan
    for own in batches(segments, offsets):
        layout = Padded.of(own, offsets)
        own_r, own_l = layout.take(r)[:, :, None], layout.take(length_scale, 1.0)[:, :, None]
        is_wanted = np.isfinite(knot_u[own])
        n_knots = int(is_wanted.sum(axis=1).max())
        is_wanted, knots = is_wanted[:, :n_knots], frame.knots[:n_knots]
        knot_l = np.where(is_wanted, np.exp(knot_u[own, :n_knots]), 1.0)[:, None]
        within = paciorek(own_r, own_l, own_r.swapaxes(1, 2), own_l.swapaxes(1, 2), sill)
        within += line_covariance(own_r, own_r.swapaxes(1, 2), *line)
        add_noise(within, layout.take(noise), layout.mask)
        unit = inverse_of_lower(np.linalg.cholesky(within)) * layout.mask[:, :, None]
        rows = paciorek(own_r, own_l, knots, knot_l, sill) + line_covariance(own_r, knots, *line)
        rows = np.matmul(unit, rows)
        height = np.matmul(np.matmul(unit, layout.take(z)[:, :, None]).swapaxes(1, 2), rows)[:, 0]
        variance = prior_variance(sill, observation, knots)
        variance = variance - np.einsum('sij,sij->sj', rows, rows)
        found.mean[own, :n_knots] = np.where(is_wanted, height, np.nan)
        std = np.sqrt(np.maximum(variance, 0.0))
        found.std[own, :n_knots] = np.where(is_wanted, std, np.nan)
