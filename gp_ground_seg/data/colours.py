"""The one colour code of pictures, viewers, RViz and Foxglove."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.core.frame import FloatArray

COLOURS = {
    'ground': '#B9BFC6',
    'obstacle': '#D55E00',
    'unknown': '#E3E6E9',
    'not scored': '#E3E6E9',
    'right': '#BCC2C8',
    'missed ground': '#0072B2',
    'false ground': '#AA3377',
}
"""Colours of points by their label, and by what it is against the truth."""
HEIGHTS = (-0.5, 3.0)
"""Heights over the ground [m] from which to which `ramp_colours` go."""
UNKNOWN = (0.5, 0.5, 0.5)
"""Colour of a value that is not known."""

# Lightness rises evenly from one to the next, and hue only goes from blue to yellow: that
# is told apart with any of the common colour vision deficiencies, and in print.
_RAMP = np.array(
    [[0.02, 0.12, 0.40], [0.16, 0.30, 0.56], [0.36, 0.47, 0.60],
     [0.58, 0.63, 0.56], [0.82, 0.79, 0.42], [1.00, 0.95, 0.50]]
)  # fmt: skip


def ramp_colours(values: FloatArray, low: float, high: float) -> FloatArray:
    """Return colours from dark blue at `low` to pale yellow at `high`, low < high.

    Values beyond take the colour of the end, and NaN that of `UNKNOWN`. Returns red, green and
    blue in [0, 1], (..., 3).
    """
    known = np.isfinite(values)
    share = (np.where(known, values, low) - low) / (high - low)
    stops = np.linspace(0.0, 1.0, len(_RAMP))
    colours = np.stack([np.interp(share, stops, channel) for channel in _RAMP.T], axis=-1)
    colours[~known] = UNKNOWN
    return colours
