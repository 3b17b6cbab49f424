"""What the pictures share: figures without a display, colours, checks of their input."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import MissingDependencyError, PointCloudError
from gp_ground_seg.frame import FloatArray

DPI = 120
UNKNOWN = (0.5, 0.5, 0.5)
"""Colour of a length-scale that is not known."""

# Okabe and Ito's palette and one violet: told apart with any colour vision.
BLUE, SKY, GREEN, ORANGE, VERMILION, PINK, VIOLET = (
    '#0072B2', '#56B4E9', '#009E73', '#E69F00', '#D55E00', '#CC79A7', '#7A4FA3',
)  # fmt: skip

# Lightness rises evenly from one to the next, and hue only goes from blue to yellow: that
# is told apart with any of the common colour vision deficiencies, and in print.
_RAMP = np.array(
    [
        [0.02, 0.12, 0.40],
        [0.16, 0.30, 0.56],
        [0.36, 0.47, 0.60],
        [0.58, 0.63, 0.56],
        [0.82, 0.79, 0.42],
        [1.00, 0.95, 0.50],
    ]
)


def new_figure(width: float, height: float, dpi: int = DPI) -> Any:
    """Return an empty matplotlib figure [inch] outside pyplot's global state.

    Raises
    ------
    MissingDependencyError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError(
            "drawing needs matplotlib: pip install 'gp_ground_seg[plot]'"
        ) from error
    return Figure((width, height), dpi=dpi)


def save(figure: Any, path: str | Path, *, force: bool = True) -> None:
    """Write a figure as PDF where `path` ends so, else as PNG.

    Raises
    ------
    DataError
        If the file cannot be written, or exists and `force` is false.
    """
    kind = 'pdf' if Path(path).suffix.lower() == '.pdf' else 'png'
    # With its date no PDF would equal another.
    metadata = {'CreationDate': None} if kind == 'pdf' else {}
    with staged_file(path, force=force) as part:
        figure.savefig(part, format=kind, metadata=metadata)


def check_lengths(n_points: int, **values: Any) -> None:
    """Check that arrays have one value per point; those that are None are left out.

    Raises
    ------
    PointCloudError
        If one has another shape than (n_points,).
    """
    for name, array in values.items():
        if array is not None and array.shape != (n_points,):
            raise PointCloudError(
                f'{name} of shape {array.shape} for {n_points} points: must be ({n_points},)'
            )


def length_scale_colours(length_scale: FloatArray, low: float, high: float) -> FloatArray:
    """Return colours from dark blue (rough ground) to pale yellow (smooth), on a log scale.

    Parameters
    ----------
    length_scale : array of float
        [m]; NaN gives `UNKNOWN`.
    low, high : float
        Length-scales at the ends of the ramp [m], 0 < low < high; values beyond take the
        colour of the end.

    Returns
    -------
    (..., 3) float64
        Red, green and blue in [0, 1].
    """
    known = np.isfinite(length_scale) & (length_scale > 0.0)
    value = np.log(np.where(known, length_scale, low) / low) / math.log(high / low)
    stops = np.linspace(0.0, 1.0, len(_RAMP))
    colours = np.stack([np.interp(value, stops, channel) for channel in _RAMP.T], axis=-1)
    colours[~known] = UNKNOWN
    return colours
