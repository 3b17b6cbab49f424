"""Lines that set off where the ground bends: the foot of a ramp between two rings."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gp_ground_seg.line_extraction import Lines
from gp_ground_seg.polar_grid import Candidates

FEWEST_CANDIDATES = 3
"""Candidates that a line needs to be one: through two there is always one."""


def set_off_at_bend(
    lines: Lines,
    candidates: Candidates,
    offset_tolerance: float,
    min_extent: float,
    max_slope: float,
) -> npt.NDArray[np.bool_]:
    """Tell the lines that meet the one before them between the two, (Q,) bool.

    Where the ground bends, the line before and the line after, drawn on towards each
    other, cross between the last candidate of the one and the first of the other. At a
    step they do not: an obstacle's line passes over, or starts over, the ground's.

    Parameters
    ----------
    lines : Lines
        Lines through the candidates.
    candidates : Candidates
        Ground candidates.
    offset_tolerance : float
        Height by which they may miss each other [m].
    min_extent : float
        Least horizontal extent of the line: longer than what stands on the ground [m].
    max_slope : float
        Steepest slope dz/dr of the line.
    """
    first, behind = lines.start[:-1], lines.start[1:]
    size = behind - first
    steep = np.abs(np.nan_to_num(lines.slope, nan=np.inf)) > max_slope
    is_long = (size >= FEWEST_CANDIDATES) & (lines.extent(candidates) >= min_extent) & ~steep
    segment = candidates.segment
    chosen = np.flatnonzero(is_long & (first > 0))
    chosen = chosen[segment[first[chosen]] == segment[first[chosen] - 1]]
    start, stop, number = first[chosen], behind[chosen], size[chosen]
    last = start - 1
    r, z = candidates.r, candidates.z
    sum_r, sum_z = np.cumsum(r), np.cumsum(z)
    mean_r = (sum_r[stop - 1] - sum_r[last]) / number
    mean_z = (sum_z[stop - 1] - sum_z[last]) / number
    over_last = mean_z + lines.slope[chosen] * (r[last] - mean_r) - z[last]
    slope_before = lines.slope[lines.line[last]]
    # Of a single candidate, or one over the other, nothing says how it goes on: level.
    slope_before = np.where(np.abs(slope_before) <= max_slope, slope_before, 0.0)
    over_line = z[start] - (z[last] + slope_before * (r[start] - r[last]))
    upwards = (over_last <= offset_tolerance) & (over_line >= -offset_tolerance)
    downwards = (over_last >= -offset_tolerance) & (over_line <= offset_tolerance)
    result = np.zeros(len(size), dtype=np.bool_)
    result[chosen] = upwards | downwards
    return result
