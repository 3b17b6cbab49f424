"""Lines along the ground candidates of a segment, cut at critical points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import compiled
from gp_ground_seg.config import LinesConfig
from gp_ground_seg.polar_grid import Candidates, FloatArray, IntArray


@dataclass(frozen=True)
class Lines:
    """Extracted lines of all segments.

    Attributes
    ----------
    line : (C,) int64
        Line of each candidate.
    slope : (Q,) float64
        Slope dz/dr of each line; NaN for a line of one point.
    start : (Q + 1,) int64
        Candidates of line q are ``start[q]:start[q + 1]``.
    """

    line: IntArray
    slope: FloatArray
    start: IntArray

    def extent(self, candidates: Candidates) -> FloatArray:
        """Horizontal extent of each line, (Q,) float64 [m]."""
        value: FloatArray = candidates.r[self.start[1:] - 1] - candidates.r[self.start[:-1]]
        return value

    def continued(self, max_slope: float, min_size: int) -> npt.NDArray[np.bool_]:
        """Candidates that continue the line of the one before them, (C,) bool.

        Of lines that are no steeper than `max_slope` and have at least `min_size`
        candidates: what is longer and flatter than an obstacle, and hangs together.
        """
        counts = (np.abs(self.slope) <= max_slope) & (np.diff(self.start) >= min_size)
        result: npt.NDArray[np.bool_] = counts[self.line]
        result[self.start[:-1]] = False
        return result


def extract_lines(candidates: Candidates, lines: LinesConfig) -> Lines:
    """Cut each segment's candidates into lines (paper, section III-D and Algorithm 1).

    A line grows over the candidates in order of range until the next one makes
    a critical point: a gap, a change of slope or of height at the new point, a
    distance from the line that is too large, or a sharp change of the vertical
    density. The next line starts there, from scratch.

    Parameters
    ----------
    candidates : Candidates
        Ground candidates.
    lines : LinesConfig
        Tolerances.
    """
    line, slope, start, n_lines = _extract(
        candidates.offsets,
        candidates.r,
        candidates.z,
        np.log(candidates.density),
        lines.slope_tolerance,
        lines.offset_tolerance,
        lines.max_line_distance,
        lines.max_gap,
        lines.max_gap_growth,
        math.log(lines.max_density_ratio),
        lines.error_ratio,
    )
    return Lines(line, slope[:n_lines], start[: n_lines + 1])


def _deming_from_moments(s_rr: float, s_zz: float, s_rz: float, error_ratio: float) -> float:
    """Slope of the line with errors in both variables, from central moments."""
    difference = s_zz - error_ratio * s_rr
    root = math.sqrt(difference * difference + 4.0 * error_ratio * s_rz * s_rz)
    # Two equal forms; each is free of cancellation where it is used.
    if difference > 0.0:
        numerator, denominator = difference + root, 2.0 * s_rz
    else:
        numerator, denominator = 2.0 * error_ratio * s_rz, root - difference
    if denominator == 0.0:
        return math.inf if numerator > 0.0 else 0.0
    return numerator / denominator


deming_slope = compiled(_deming_from_moments)
"""Slope dz/dr of Deming's regression (paper, section III-D, distance-oriented regression).

Parameters: sums of squares and products about the mean ``s_rr``, ``s_zz``,
``s_rz`` [m^2], and ``error_ratio``, the variance of the height error over that
of the range error. A vertical line has an infinite slope.
"""


@compiled
def _extract(
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    log_density: FloatArray,
    slope_tolerance: float,
    offset_tolerance: float,
    max_line_distance: float,
    max_gap: float,
    max_gap_growth: float,
    max_log_density_change: float,
    error_ratio: float,
) -> tuple[IntArray, FloatArray, IntArray, int]:
    line = np.empty(len(r), np.int64)
    start = np.empty(len(r) + 1, np.int64)
    slopes = np.full(len(r), np.nan)
    current = -1
    for m in range(len(offsets) - 1):
        i = offsets[m]
        while i < offsets[m + 1]:
            current += 1
            # Sums relative to the first point of the line keep their digits.
            n = 0
            sum_r = sum_z = sum_rr = sum_zz = sum_rz = 0.0
            slope = angle = np.nan
            j = i
            while j < offsets[m + 1]:
                dr, dz = r[j] - r[i], z[j] - z[i]
                if n > 0 and (
                    r[j] - r[j - 1] > max_gap + max_gap_growth * r[j]
                    or abs(log_density[j] - log_density[j - 1]) > max_log_density_change
                ):
                    break
                new_r, new_z = (sum_r + dr) / (n + 1), (sum_z + dz) / (n + 1)
                new_slope = new_angle = np.nan
                if n > 0:
                    new_slope = deming_slope(
                        sum_rr + dr * dr - (n + 1) * new_r * new_r,
                        sum_zz + dz * dz - (n + 1) * new_z * new_z,
                        sum_rz + dr * dz - (n + 1) * new_r * new_z,
                        error_ratio,
                    )
                    new_angle = math.atan(new_slope)
                if n > 1:
                    before = sum_z / n + slope * (dr - sum_r / n)
                    after = new_z + new_slope * (dr - new_r)
                    turn = abs(new_angle - angle)
                    distance = abs(dz - before) / math.sqrt(1.0 + slope * slope)
                    if (
                        turn > slope_tolerance
                        or abs(after - before) > offset_tolerance
                        or distance > max_line_distance
                    ):
                        break
                n += 1
                sum_r += dr
                sum_z += dz
                sum_rr += dr * dr
                sum_zz += dz * dz
                sum_rz += dr * dz
                slope, angle = new_slope, new_angle
                j += 1
            line[i:j] = current
            start[current] = i
            slopes[current] = slope
            i = j
    start[current + 1] = len(r)
    return line, slopes, start, current + 1
