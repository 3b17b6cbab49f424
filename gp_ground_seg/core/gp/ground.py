"""Stage 5: the observation process: inlier growth, and the surface of every segment."""

import math
from collections.abc import Callable

import numpy as np

from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    FloatArray,
    Frame,
    GroundSurface,
    IntArray,
    PointArray,
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
    batches,
    line_covariance,
    line_variances,
    paciorek,
    prior_variance,
    single_threaded_blas,
    whitened,
)
from gp_ground_seg.core.gp.latent import (
    given_log_length_scales,
    given_theta,
    latent_log_length_scales,
)
from gp_ground_seg.core.gp.model import Model, SegmentSurfaces, scaled
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import Config, GrowthConfig, ObservationConfig
from gp_ground_seg.core.pipeline.lines import is_walkable


def estimate_surface(
    frame: Frame, theta: FloatArray, config: Config, fit: Callable[..., None] | None = None
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

    Where neighbours are used, one of `STEP` segments grows by itself first. Its innovations tell
    how smooth the ground of the frame is, which narrows the prior. Then all grow: the prediction
    is that of the segment and of those beside it together, and what stands above the latter alone
    does not start the set (see `gp_ground_seg.core.gp.evidence`). The surface, too, is that of the
    segment and of those beside it together.
    """
    knots, observation, mean, std = frame.knots, model.observation, found.mean, found.std
    u, knot_u = found.log_length_scale, found.knot_log_length_scale
    if model.is_latent:
        latent_log_length_scales(frame, given, 1, u, knot_u)
    from_neighbours, scale = Evidence(np.empty((0, 0)), np.empty((0, 0))), 1.0
    if model.uses_neighbours:
        find_seeds(frame, given, observation.slope_std, found.seed)
        mean_square = grow_inliers(frame, given, model, from_neighbours, STEP, found)
        regress(frame, given, observation, STEP, found)
        scale = max(min(ROUGHEST * math.sqrt(mean_square), 1.0), LEAST_SCALE)
        given, model = scaled(given, model, scale)
        from_neighbours = evidence_of_neighbours(
            mean, scale * std, knots, given, model.observation
        )
        found.seed[:] &= (
            np.abs(frame.candidates.z - frame.prior_mean)
            <= scale * model.growth.seed_height_tolerance
        )
    grow_inliers(frame, given, model, from_neighbours, 1, found)
    found.doubt[:] /= scale * scale  # as if the prior had not been scaled: `theta` is not
    if model.is_latent and (theta[2:] != given[2:]).any():
        latent_log_length_scales(frame, theta, 1, u, knot_u)
    regress(frame, theta, observation, 1, found)
    if model.uses_neighbours:
        from_neighbours = evidence_of_neighbours(mean, std, knots, theta, observation)
        join_evidence(found, from_neighbours, knots, theta, observation)
    mean += frame.prior_mean


_Places = tuple[PointArray, PointArray]  # ranges, and length-scales there [m]

OBSTACLE_DEPTH = 1.0
"""Height over which the lowest returns of obstacles are spread [m]."""
ODDS, ODDS_IN_FACE = 0.25, 4.0
"""Odds that a candidate is an obstacle, and that one in a vertical face is."""
MOST_DOUBT = 30.0
"""Logarithm of odds that are as good as infinite."""
ROUNDING, ROUNDING_SINGLE = 1e-12, 1e-6
"""Least noise of what is observed, in parts of the largest covariance: its rounding, in double and
in single precision. With less, a predicted variance could be negative."""
FARTHEST = 1e15
"""Height over which all are equally far from a surface [m]: single precision holds its square."""
RISES_ON = 0.8
"""Part of the slope to a candidate with which the ground behind it must rise on."""
LEAST_SCALE, ROUGHEST = 0.2, 3.0
"""Least scale of the prior, and its scale over the root mean square of the innovations, at which
the likelihood is greatest: ground that has not joined yet may be so many times as rough as that
which has."""


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
) -> float:
    """Let the inliers of every `step`-th segment grow from seeds, in `found`, under `theta`.

    A candidate joins when its height `fits` the prediction, or when the ground carries on to it
    from the inlier before (see `carries_on`). This repeats until none joins (GP-INSAC of Chen et
    al. 2014; the paper's outlier rejection).

    `from_neighbours` is the evidence of the segments beside each. If ``label.rule`` is roughness,
    a candidate among others, or that joins in doubt, shows less: see `noise_among` and
    `noise_in_doubt`. Where the ground carries on to it there is no doubt. Returns the mean square
    of the innovations of the inliers, in standard deviations; 1 without any.
    """
    sill, gate_noise = variances_of(frame, theta, model.observation, ROUNDING_SINGLE)
    grows = frame.candidates.segment % step == 0
    of_these = {name: getattr(frame, name)[grows] for name in ('onward', 'land', 'in_face')}
    frame = frame._replace(candidates=frame.candidates.where(grows), **of_these)
    candidates, segment = frame.candidates, frame.candidates.segment
    z, growth = candidates.z - frame.prior_mean, model.growth
    alike = _count_near(candidates, np.exp(theta[3]) if model.by_roughness else 0.0)
    certain, beside = noise_among(alike, gate_noise), at_candidates(from_neighbours, frame)
    above, noise = contradicts(*beside, z, gate_noise) & ~frame.land, certain.copy()
    tables = _prior_tables(frame, found.log_length_scale[grows], sill, model.observation)
    prior, stops = prior_variance(sill, model.observation, candidates.r), frame.in_face | above
    predicted = combined(np.zeros(len(z)), prior, *beside)
    chosen, joining = np.zeros(len(z), np.bool_), found.seed[grows] & ~above
    in_doubt, has_inliers = joining & frame.in_face, np.zeros(candidates.n_segments, np.bool_)
    with np.errstate(over='ignore', invalid='ignore'):  # the square of 1e200 m: no fit
        while True:
            if model.by_roughness:
                known = (values[in_doubt] for values in (z, *predicted, noise, frame.in_face))
                noise[in_doubt] = noise_in_doubt(*known)
            chosen |= joining
            residual, variance = _observe(tables, candidates, joining, noise)
            predicted = combined(z - residual, variance, *beside)
            fitting = fits(z, *predicted, gate_noise, growth)
            on_slope, is_shown = _on_slope(frame, chosen, fitting, stops, growth)
            # Before anything has joined, only the evidence of neighbours decides.
            has_inliers[segment[joining]] = True
            may_join = ~chosen & (has_inliers[segment] | (beside.precision > 0.0))
            joining, in_doubt = may_join & (fitting | on_slope), may_join & fitting & ~is_shown
            if not joining.any():
                break
    found.inlier[:] = False
    found.inlier[grows], found.alike[grows], found.doubt[grows] = chosen, alike, noise - certain
    return -float(tables[:, 0, 0].sum()) / chosen.sum() if chosen.any() else 1.0


def _on_slope(
    frame: Frame, chosen: BoolArray, fitting: BoolArray, stops: BoolArray, growth: GrowthConfig
) -> tuple[BoolArray, BoolArray]:
    """Candidates to which the ground goes on from the last of those `chosen`, (C,).

    Of the second ones the returns behind or before them show that it rises. Behind one that stands
    on it, or is one of `stops`, it does not go on, until the next that is chosen.
    """
    (r, z, *_), offsets = frame.candidates, frame.candidates.offsets
    place, first = np.arange(len(r)), np.repeat(offsets[:-1], np.diff(offsets))

    def last(marked: BoolArray) -> IntArray:
        """Place of the last one `marked` before each, in any segment, -1 if none."""
        found = np.maximum.accumulate(np.where(marked, place, -1))
        return np.concatenate([[-1], found])[:-1]

    before = last(chosen)
    rise, distance = z - z[before], r - r[before]
    walkable = is_walkable(rise, distance, growth.max_slope) & ~stops
    is_open = (before >= first) & (last(~chosen & ~fitting & ~walkable) < before) & walkable
    is_shown = is_open & carries_on(rise, distance, frame.onward, frame.land)
    return is_shown | (is_open & (rise <= 0.0)), is_shown


@shared
def carries_on(rise: Values, distance: Values, onward: Values, land: Values) -> Values:
    """Whether the ground is seen to go on as it rises by so much [m] over a distance [m].

    On land it is. Elsewhere `onward`, the slope behind, shows it: where it is less, the ground has
    come to an object.
    """
    return (rise > 0.0) & (land | (RISES_ON * rise <= onward * distance))


def _prior_tables(
    frame: Frame, u: FloatArray, sill: float, observation: ObservationConfig
) -> PointArray:
    """Prior of every segment by log length-scales `u` (C,).

    The table of a segment has a row and a column with the residuals of its candidates, and then
    the covariance of their heights; conditioned, it begins with the negative sum of the squared
    innovations. In single precision, (M, 1 + n, 1 + n) for at most n.
    """
    candidates = frame.candidates
    z = np.clip(candidates.z - frame.prior_mean, -FARTHEST, FARTHEST)
    width = 1 + np.diff(candidates.offsets).max(initial=0)
    tables = np.zeros((candidates.n_segments, width, width), np.float32)
    for segments in batches(np.arange(candidates.n_segments), candidates.offsets):
        layout = Padded.of(segments, candidates.offsets)
        columns = (layout.take(values).astype(np.float32) for values in (candidates.r, u, z))
        r, own_u, residual = columns
        places, own = (r, np.exp(own_u)), slice(1, 1 + r.shape[1])
        tables[segments, 0, own] = tables[segments, own, 0] = residual
        tables[segments, own, own] = _prior(places, places, sill, observation)
    return tables


def _observe(
    tables: PointArray, candidates: Candidates, new: BoolArray, noise: FloatArray
) -> tuple[PointArray, FloatArray]:
    """Observe the candidates that are `new`, with `noise`, two (C,); residuals and variances."""
    offsets, segment, which = candidates.offsets, candidates.segment, np.flatnonzero(new)
    bounds, size = np.searchsorted(which, offsets), 1 + np.diff(offsets)
    column = np.arange(1, len(new) + 1) - offsets[segment]
    # One by one: a batch of small matrices is mostly padding. Whole rows lie side by side.
    for m in np.flatnonzero(np.diff(bounds)):
        table, own = tables[m, : size[m]], which[bounds[m] : bounds[m + 1]]
        rows = table.take(column[own], axis=0)
        within = rows.take(column[own], axis=1)
        within.ravel()[:: len(within) + 1] += noise[own]
        rows = whitened(within, rows)
        table -= rows[:, : size[m]].T @ rows
    return tables[segment, 0, column], tables[segment, column, column].astype(np.float64)


def _prior(a: _Places, b: _Places, sill: float, observation: ObservationConfig) -> PointArray:
    """Prior covariance of heights at ranges with length-scales, (S, n) and (S, k) [m^2]."""
    r_a, r_b = a[0][:, :, None], b[0][:, None]
    covariance: PointArray = paciorek(r_a, a[1][:, :, None], r_b, b[1][:, None], sill)
    covariance += line_covariance(r_a, r_b, *line_variances(observation))
    return covariance


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
    sill, noise = variances_of(frame, theta, observation, ROUNDING)
    noise = (noise_among(found.alike, noise) + found.doubt)[which]
    r, z = candidates.r[which], candidates.z[which] - frame.prior_mean
    length_scale = np.exp(found.log_length_scale[which])
    offsets = np.searchsorted(which, candidates.offsets)
    found.mean[::step] = found.std[::step] = np.nan
    for own in batches(np.arange(0, candidates.n_segments, step), offsets):
        layout = Padded.of(own, offsets)
        places = layout.take(r), layout.take(length_scale, 1.0)
        # NaN behind the last knot that is wanted, and so is what follows there.
        n_knots = int(np.isfinite(knot_u[own]).sum(axis=1).max())
        knots, knot_l = frame.knots[:n_knots], np.exp(knot_u[own, :n_knots])
        within = _prior(places, places, sill, observation)
        np.einsum('sii->si', within)[:] += layout.take(noise)
        rows = _prior(places, (knots[None], knot_l), sill, observation)
        rows = np.concatenate([rows, layout.take(z)[:, :, None]], axis=2)
        for own_rows, covariance, n in zip(rows, within, layout.mask.sum(axis=1), strict=True):
            own_rows[:n] = whitened(covariance[:n, :n], own_rows[:n])
            own_rows[n:] = 0.0
        rows, own_z = rows[:, :, :-1], rows[:, :, -1:]
        variance = prior_variance(sill, observation, knots) - np.einsum('sij,sij->sj', rows, rows)
        found.mean[own, :n_knots] = np.matmul(own_z.swapaxes(1, 2), rows)[:, 0]
        found.std[own, :n_knots] = np.sqrt(np.maximum(variance, 0.0))
