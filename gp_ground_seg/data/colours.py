"""Colours of the length-scale, the same in pictures, viewers and RViz."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.frame import FloatArray

UNKNOWN = (0.5, 0.5, 0.5)
"""Colour of a length-scale that is not known."""

# Lightness rises evenly from one to the next, and hue only goes from blue to yellow: that
# is told apart with any of the common colour vision deficiencies, and in print.
_RAMP = np.array(
    [[0.02, 0.12, 0.40], [0.16, 0.30, 0.56], [0.36, 0.47, 0.60],
     [0.58, 0.63, 0.56], [0.82, 0.79, 0.42], [1.00, 0.95, 0.50]]
)  # fmt: skip


def length_scale_colours(length_scale: FloatArray, low: float, high: float) -> FloatArray:
    """Return colours from dark blue (rough ground) to pale yellow (smooth), on a log scale.

    The ramp goes from `low` to `high` [m], 0 < low < high; values beyond take the colour of
    the end, and NaN that of `UNKNOWN`. Returns red, green and blue in [0, 1], (..., 3).
    """
    known = np.isfinite(length_scale) & (length_scale > 0.0)
    value = np.log(np.where(known, length_scale, low) / low) / math.log(high / low)
    stops = np.linspace(0.0, 1.0, len(_RAMP))
    colours = np.stack([np.interp(value, stops, channel) for channel in _RAMP.T], axis=-1)
    colours[~known] = UNKNOWN
    return colours
