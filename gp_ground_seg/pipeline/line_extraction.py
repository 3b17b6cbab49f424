"""Lines along the ground candidates of a segment, cut at critical points."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import Candidates, FloatArray, IntArray, Lines
from gp_ground_seg.jit import HAVE_NUMBA, compiled
from gp_ground_seg.parameters.config import LinesConfig


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
    columns = candidates.offsets, candidates.r, candidates.z, candidates.density
    # Plain Python reads lists much faster than arrays.
    offsets, r, z, density = columns if HAVE_NUMBA else _lists(*columns)
    line, slope, start = extract(
        offsets,
        r,
        z,
        density,
        lines.slope_tolerance,
        lines.offset_tolerance,
        lines.max_line_distance,
        lines.max_gap,
        lines.max_gap_growth,
        lines.max_density_ratio,
        lines.error_ratio,
    )
    return Lines(line, slope, start)


def _lists(*columns: npt.NDArray[Any]) -> Any:
    return [column.tolist() for column in columns]


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
def extract(
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    density: FloatArray,
    slope_tolerance: float,
    offset_tolerance: float,
    max_line_distance: float,
    max_gap: float,
    max_gap_growth: float,
    max_density_ratio: float,
    error_ratio: float,
) -> tuple[IntArray, FloatArray, IntArray]:
    """Do what `extract_lines` does, from the fields of candidates to those of lines."""
    line = np.empty(len(r), np.int64)
    start = np.empty(len(r) + 1, np.int64)
    slopes = np.empty(len(r))
    tangent = math.tan(slope_tolerance)
    square_distance = max_line_distance * max_line_distance
    current = 0
    for m in range(len(offsets) - 1):
        stop = offsets[m + 1]
        i = offsets[m]
        while i < stop:
            # Sums relative to the first point of the line keep their digits.
            first_r, first_z = r[i], z[i]
            sum_r, sum_z, sum_rr, sum_zz, sum_rz = 0.0, 0.0, 0.0, 0.0, 0.0
            mean_r, mean_z = 0.0, 0.0
            slope = np.nan
            start[current] = i
            line[i] = current
            n = 1
            j = i + 1
            while j < stop:
                last_density, own_density = density[j - 1], density[j]
                if (
                    r[j] - r[j - 1] > max_gap + max_gap_growth * r[j]
                    or own_density > max_density_ratio * last_density
                    or last_density > max_density_ratio * own_density
                ):
                    break
                dr, dz = r[j] - first_r, z[j] - first_z
                expected = mean_z + slope * (dr - mean_r)
                missed = dz - expected
                if n > 1 and missed * missed > square_distance * (1.0 + slope * slope):
                    break
                n += 1
                sum_r += dr
                sum_z += dz
                sum_rr += dr * dr
                sum_zz += dz * dz
                sum_rz += dr * dz
                mean_r, mean_z = sum_r / n, sum_z / n
                new_slope = deming_slope(
                    sum_rr - n * mean_r * mean_r,
                    sum_zz - n * mean_z * mean_z,
                    sum_rz - n * mean_r * mean_z,
                    error_ratio,
                )
                if n > 2:
                    moved = mean_z + new_slope * (dr - mean_r) - expected
                    if abs(moved) > offset_tolerance or turns(
                        slope, new_slope, slope_tolerance, tangent
                    ):
                        break
                slope = new_slope
                line[j] = current
                j += 1
            slopes[current] = slope
            current += 1
            i = j
    start[current] = len(r)
    return line, slopes[:current], start[: current + 1]


@compiled
def turns(slope: float, new_slope: float, tolerance: float, tangent: float) -> bool:
    """Tell whether two lines differ in direction by more than `tolerance`, with its tangent."""
    # An arctangent costs as much as the rest of a step: the tangent of the difference
    # of two angles follows from their tangents.
    along = 1.0 + slope * new_slope
    if math.isfinite(along):
        return along <= 0.0 or abs(new_slope - slope) > tangent * along
    return abs(math.atan(new_slope) - math.atan(slope)) > tolerance
