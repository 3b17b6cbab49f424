"""Stage 5: length-scales, from the latent process or simpler models."""

import numpy as np

from gp_ground_seg.core.frame import FloatArray, Frame, IntArray
from gp_ground_seg.core.gp.kernels import Padded, batches, squared_exponential
from gp_ground_seg.core.parameters.config import Config, LengthScaleConfig
from gp_ground_seg.core.pipeline.lines import N_CLASSES

MAX_ABS_LOG_LENGTH_SCALE = 100.0
"""Bound of the latent process [log m], far outside all scans, for squares that stay finite.

With `latent.sigma_f_bar` near its upper end the mean between pseudo-inputs swings that far.
"""


def given_theta(config: Config) -> FloatArray:
    """Values given by the configuration, (T,), in log space; T is 6, with classes 14."""
    observation, latent = config.observation, config.latent
    values = (
        observation.sigma_f,
        observation.sigma_n,
        latent.sigma_f_bar,
        latent.sigma_l_bar,
        latent.sigma_n_bar,
    )
    n_factors = N_CLASSES if config.learning.length_scale == 'classes' else 1
    return np.append(np.log(values), np.zeros(n_factors))


def n_wanted_knots(frame: Frame) -> IntArray:
    """Count the knots up to the bin of the last candidate of each segment, (M,) int64.

    Behind it nothing is known of the ground.
    """
    return np.minimum(frame.candidates.n_edges, len(frame.knots))


def latent_log_length_scales(
    frame: Frame,
    theta: FloatArray,
    step: int,
    log_length_scale: FloatArray,
    knot_log_length_scale: FloatArray,
) -> None:
    """Mean of the latent process at candidates and knots (paper, eqs. 10 and 11).

    The pseudo-inputs are centred on their mean, so that equal ones give that very value
    everywhere.

    `theta`, (T,), are the hyper-parameters (see `gp_ground_seg.core.gp.learning`). Sets the log
    length-scales of every `step`-th segment at the candidates, (C,), and at the knots, (M, K)
    [log m]; NaN there behind the bin of the last candidate.
    """
    candidates, pseudo, n_knots = frame.candidates, frame.pseudo, n_wanted_knots(frame)
    sill_bar, square_l_bar, noise_bar = np.exp(2.0 * theta[2:5]).tolist()
    kernel, bound = (sill_bar, 0.5 / square_l_bar), MAX_ABS_LOG_LENGTH_SCALE
    knot_log_length_scale[::step] = np.nan
    for segments in batches(np.arange(0, candidates.n_segments, step), candidates.offsets):
        layout = Padded.of(segments, candidates.offsets)
        bar = Padded.of(segments, pseudo.offsets)
        r_bar, n = bar.take(pseudo.r_bar), layout.mask.shape[1]
        l_bar = bar.take(pseudo.log_extent) + theta[5 + pseudo.kind[bar.place]]
        l_bar = np.where(bar.mask, l_bar, 0.0)
        mean = l_bar.sum(axis=1, keepdims=True) / bar.mask.sum(axis=1, keepdims=True)
        covariance = squared_exponential(r_bar[:, :, None], r_bar[:, None, :], *kernel)
        # Padding has so much noise that it tells nothing.
        np.einsum('sii->si', covariance)[:] += np.where(bar.mask, noise_bar, 1e30)
        centred = np.where(bar.mask, l_bar - mean, 0.0)
        weight = np.linalg.solve(covariance, centred[:, :, None]).swapaxes(1, 2)
        knots = frame.knots[: n_knots[segments].max()]
        wanted = np.empty((len(r_bar), 1, n + len(knots)))
        wanted[:, 0, :n], wanted[:, 0, n:] = layout.take(candidates.r), knots
        cross = squared_exponential(r_bar[:, :, None], wanted, *kernel)
        found = np.clip((weight @ cross)[:, 0] + mean, -bound, bound)
        log_length_scale[layout.place[layout.mask]] = found[:, :n][layout.mask]
        is_wanted = np.arange(len(knots)) < n_knots[segments, None]
        knot_log_length_scale[segments, : len(knots)] = np.where(is_wanted, found[:, n:], np.nan)


def given_log_length_scales(
    frame: Frame, length_scale: LengthScaleConfig
) -> tuple[FloatArray, FloatArray]:
    """Log length-scales at the candidates, (C,), and at the knots, (M, K) [log m].

    One constant, or those of the lines: linear between the candidates. Arbitrary ones, to be set,
    where the model is the latent process.
    """
    candidates, knots = frame.candidates, frame.knots
    at_knots = np.full((candidates.n_segments, len(knots)), np.nan)
    if length_scale.model == 'latent':
        return np.empty(len(candidates.r)), at_knots
    n_knots = n_wanted_knots(frame)
    if length_scale.model == 'constant':
        u = np.full(len(candidates.r), np.log(length_scale.constant))
    else:
        of_lines = line_gradient_length_scale(frame.lines.slope, length_scale)
        u = np.log(of_lines)[frame.lines.line]
    for m in np.flatnonzero(n_knots):
        inside, n = slice(candidates.offsets[m], candidates.offsets[m + 1]), n_knots[m]
        at_knots[m, :n] = np.interp(knots[:n], candidates.r[inside], u[inside])
    return u, at_knots


def line_gradient_length_scale(slope: FloatArray, length_scale: LengthScaleConfig) -> FloatArray:
    """Length-scale of lines of these slopes, (Q,) [m] (Chen et al. 2014, method "Z").

    ``l = a log(1 / max(|slope|, flat_gradient))``, kept within the bounds. A line of one point
    has no slope (NaN) and gets the smallest length-scale.
    """
    steepness = np.maximum(np.abs(slope), length_scale.flat_gradient)
    value = -length_scale.gradient_gain * np.log(steepness)
    value = np.where(np.isnan(slope), length_scale.min, value)
    return np.clip(value, length_scale.min, length_scale.max)
