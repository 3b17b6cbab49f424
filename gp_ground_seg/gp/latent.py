"""Stage 5a: length-scales, from the latent process or simpler models."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.frame import Candidates, FloatArray, Frame, IntArray
from gp_ground_seg.gp.kernels import squared_exponential
from gp_ground_seg.gp.linalg import Padded, add_noise, batches
from gp_ground_seg.parameters.config import LengthScaleConfig


def n_wanted_knots(frame: Frame) -> IntArray:
    """Count the knots up to the bin of the last candidate of each segment, (M,) int64.

    Behind it nothing is known of the ground.
    """
    return np.minimum(frame.candidates.n_edges, len(frame.knots))


def latent_log_length_scales(frame: Frame, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean of the latent process at the candidates and knots (paper, eqs. 10 and 11).

    The pseudo-inputs are centred on their mean, so that equal ones give that very value
    everywhere.

    Parameters
    ----------
    frame : Frame
        Candidates, pseudo-inputs and knots.
    theta : (M, 5 + K) float64
        Hyper-parameters of each segment (see `gp_ground_seg.gp.learning`).

    Returns
    -------
    at_candidates : (C,) float64
        Log length-scales [log m].
    at_knots : (M, K) float64
        The same at the knots; NaN behind the bin of the last candidate.
    """
    candidates, pseudo, knots = frame.candidates, frame.pseudo, frame.knots
    n_knots = n_wanted_knots(frame)
    at_candidates = np.empty(len(candidates.r))
    at_knots = np.full((len(theta), len(knots)), np.nan)
    for segments in batches(candidates.offsets):
        own = Padded.of(segments, candidates.offsets)
        bar = Padded.of(segments, pseudo.offsets)
        own_r, r_bar = own.take(candidates.r), bar.take(pseudo.r_bar)
        sigma_f_bar, sigma_l_bar, sigma_n_bar = np.exp(theta[segments, 2:5]).T
        classes = bar.take(pseudo.surface_class).astype(np.int64)
        l_bar = np.where(bar.mask, theta[segments[:, None], 5 + classes], 0.0)
        mean = l_bar.sum(axis=1, keepdims=True) / bar.mask.sum(axis=1, keepdims=True)
        covariance = squared_exponential(r_bar, r_bar, sigma_f_bar, sigma_l_bar)
        add_noise(covariance, sigma_n_bar[:, None] ** 2, bar.mask)
        centred = np.where(bar.mask, l_bar - mean, 0.0)
        weight = np.linalg.solve(covariance, centred[:, :, None])
        cross = squared_exponential(own_r, r_bar, sigma_f_bar, sigma_l_bar)
        at_candidates[own.place[own.mask]] = ((cross @ weight)[:, :, 0] + mean)[own.mask]
        wanted = np.broadcast_to(knots, (len(segments), len(knots)))
        cross = squared_exponential(wanted, r_bar, sigma_f_bar, sigma_l_bar)
        is_wanted = np.arange(len(knots)) < n_knots[segments, None]
        at_knots[segments] = np.where(is_wanted, (cross @ weight)[:, :, 0] + mean, np.nan)
    return at_candidates, at_knots


def given_log_length_scales(
    frame: Frame, length_scale: LengthScaleConfig
) -> tuple[FloatArray, FloatArray]:
    """Log length-scales without a latent process; returns as `latent_log_length_scales`."""
    candidates, knots = frame.candidates, frame.knots
    if length_scale.model == 'constant':
        u = np.full(len(candidates.r), np.log(length_scale.constant))
    else:
        of_lines = line_gradient_length_scale(frame.lines.slope, length_scale)
        u = np.log(of_lines)[frame.lines.line]
    at_knots = interpolate_along_segments(candidates, u, knots)
    is_wanted = np.arange(len(knots)) < n_wanted_knots(frame)[:, None]
    return u, np.where(is_wanted, at_knots, np.nan)


def line_gradient_length_scale(slope: FloatArray, length_scale: LengthScaleConfig) -> FloatArray:
    """Length-scale of lines with the given slopes (Chen et al. 2014, method "Z").

    ``l = a log(1 / max(|slope|, flat_gradient))``, kept within the bounds.
    A line of one point has no slope (NaN) and gets the smallest length-scale.

    Parameters
    ----------
    slope : (Q,) float64
        Slope dz/dr of each line.
    length_scale : LengthScaleConfig
        Gain, flat slope and bounds.

    Returns
    -------
    (Q,) float64
        Length-scales [m].
    """
    steepness = np.maximum(np.abs(slope), length_scale.flat_gradient)
    value = -length_scale.gradient_gain * np.log(steepness)
    value = np.where(np.isnan(slope), length_scale.min, value)
    return np.clip(value, length_scale.min, length_scale.max)


def interpolate_along_segments(
    candidates: Candidates, value: FloatArray, knots: FloatArray
) -> FloatArray:
    """Linear interpolation of a value of the candidates over range.

    Parameters
    ----------
    candidates : Candidates
        Ground candidates, C in M segments.
    value : (C,) float64
        Value at each candidate.
    knots : (K,) float64
        Ranges [m] wanted in every segment.

    Returns
    -------
    (M, K) float64
        Constant beyond the first and last candidate of a segment; NaN in
        segments that have none.
    """
    n_segments = len(candidates.offsets) - 1
    result = np.full((n_segments, len(knots)), np.nan)
    occupied = np.flatnonzero(np.diff(candidates.offsets))
    if len(occupied) == 0 or len(knots) == 0:
        return result
    # One call for all segments: they are laid end to end on one axis.
    stride = 2.0 * max(float(candidates.r.max()), float(knots.max())) + 1.0
    first = candidates.r[candidates.offsets[occupied]]
    last = candidates.r[candidates.offsets[occupied + 1] - 1]
    inside = np.clip(knots, first[:, None], last[:, None])
    position = inside + occupied[:, None] * stride
    axis = candidates.r + candidates.segment * stride
    result[occupied] = np.interp(position.ravel(), axis, value).reshape(position.shape)
    return result
