"""Length-scales of the observation process at the candidates and along the segments."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.frame import Candidates, FloatArray, Lines
from gp_ground_seg.parameters.config import LengthScaleConfig


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


def candidate_log_length_scale(
    candidates: Candidates, lines: Lines, length_scale: LengthScaleConfig
) -> FloatArray:
    """Log length-scale at each candidate, (C,) [log m], by the configured model."""
    if length_scale.model == 'constant':
        return np.full(len(candidates.r), np.log(length_scale.constant))
    return np.log(line_gradient_length_scale(lines.slope, length_scale))[lines.line]


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
