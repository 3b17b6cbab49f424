"""Stage 4: lines through the candidates of a segment, and pseudo-inputs on them."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    Faces,
    Lines,
    PseudoInputs,
)
from gp_ground_seg.core.parameters.config import Config, LinesConfig

MIN_BREAK_CANDIDATES = 3
"""Candidates that a line after a slope break needs: through two there is always one."""


def find_lines(
    candidates: Candidates, faces: Faces, config: Config
) -> tuple[Candidates, Lines, PseudoInputs, BoolArray]:
    """Lines through the candidates that show ground, and what follows from the lines.

    The lowest point of a face with occluded base is no candidate. Returns the candidates kept;
    see `extract_lines`, `select_pseudo_inputs` and `candidates_on_lines` for the others.
    """
    kept = candidates.where(~faces.has_occluded_base[candidates.tile])
    lines = extract_lines(kept, config.lines)
    pseudo = select_pseudo_inputs(kept, lines, config)
    return kept, lines, pseudo, candidates_on_lines(lines, kept, config)


def extract_lines(candidates: Candidates, lines: LinesConfig) -> Lines:
    """Cut each segment's candidates into lines (paper, section III-D and Algorithm 1).

    A line grows over the candidates in order of range until the next one makes
    a critical point: a gap, a change of slope or of height at the new point, a
    distance from the line that is too large, or a sharp change of the vertical
    density. The next line starts there, independent of the one before.
    """
    columns = candidates.offsets, candidates.r, candidates.z, candidates.density
    # Plain Python reads lists much faster than arrays.
    offsets, r, z, density = (column.tolist() for column in columns)
    line: list[int] = []
    start, slopes = [0], list[float]()
    for m in range(len(offsets) - 1):
        first, stop = offsets[m], offsets[m + 1]
        while first < stop:
            behind, slope = _grow_line(first, stop, r, z, density, lines)
            line += [len(slopes)] * (behind - first)
            slopes.append(slope)
            start.append(behind)
            first = behind
    return Lines(np.array(line, dtype=np.int64), np.array(slopes), np.array(start, dtype=np.int64))


def _grow_line(
    first: int,
    stop: int,
    r: list[float],
    z: list[float],
    density: list[float],
    lines: LinesConfig,
) -> tuple[int, float]:
    """Candidate behind the line from `first`, at most `stop`, and the line's slope."""
    # Sums relative to the first point of the line keep their digits.
    sum_r = sum_z = sum_rr = sum_zz = sum_rz = mean_r = mean_z = 0.0
    slope, n = math.nan, 1
    for j in range(first + 1, stop):
        ratio = lines.max_density_ratio
        if (
            r[j] - r[j - 1] > lines.max_gap + lines.max_gap_growth * r[j]
            or density[j] > ratio * density[j - 1]
            or density[j - 1] > ratio * density[j]
        ):
            return j, slope
        dr, dz = r[j] - r[first], z[j] - z[first]
        expected = mean_z + slope * (dr - mean_r)
        missed = dz - expected
        if n > 1 and missed * missed > lines.max_line_distance**2 * (1.0 + slope * slope):
            return j, slope
        n += 1
        sum_r, sum_z = sum_r + dr, sum_z + dz
        sum_rr, sum_zz, sum_rz = sum_rr + dr * dr, sum_zz + dz * dz, sum_rz + dr * dz
        mean_r, mean_z = sum_r / n, sum_z / n
        new_slope = deming_slope(
            sum_rr - n * mean_r * mean_r,
            sum_zz - n * mean_z * mean_z,
            sum_rz - n * mean_r * mean_z,
            lines.error_ratio,
        )
        if n > 2:
            moved = mean_z + new_slope * (dr - mean_r) - expected
            if abs(moved) > lines.offset_tolerance or differs_in_direction(
                slope, new_slope, lines.slope_tolerance
            ):
                return j, slope
        slope = new_slope
    return stop, slope


def deming_slope(s_rr: float, s_zz: float, s_rz: float, error_ratio: float) -> float:
    """Slope dz/dr of the line with errors in both variables: Deming's regression.

    The paper's distance-oriented regression (section III-D).

    The first three are sums of squares and products about the mean [m^2], `error_ratio` is the
    variance of the height error over that of the range error. Infinite for a vertical line.
    """
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


def differs_in_direction(slope: float, new_slope: float, tolerance: float) -> bool:
    """Whether lines of these slopes differ in direction by more than `tolerance` [rad]."""
    # The tangent of the difference of two angles follows from their tangents, which saves
    # an arctangent for each candidate.
    along = 1.0 + slope * new_slope
    if math.isfinite(along):
        return along <= 0.0 or abs(new_slope - slope) > math.tan(tolerance) * along
    return abs(math.atan(new_slope) - math.atan(slope)) > tolerance


def select_pseudo_inputs(candidates: Candidates, lines: Lines, config: Config) -> PseudoInputs:
    """Spread pseudo-inputs evenly over the candidates of each line (paper, section III-C).

    Every line gets at least one.
    """
    limits, size = config.length_scale, np.diff(lines.start)
    wanted = np.rint(size / config.latent.candidates_per_pseudo_input).astype(np.int64)
    number = np.maximum(wanted, 1)
    extent = lines.extent(candidates)
    log_extent = np.log(np.clip(extent, limits.min, limits.max))
    line = np.repeat(np.arange(len(number)), number)
    rank = np.arange(len(line)) - np.repeat(np.cumsum(number) - number, number)
    # The middle of each of `number` equal shares of the line's candidates.
    position = lines.start[line] + (size[line] * (2 * rank + 1)) // (2 * number[line])
    return PseudoInputs(
        r_bar=candidates.r[position],
        log_extent=log_extent[line],
        offsets=np.searchsorted(position, candidates.offsets),
    )


def candidates_on_lines(lines: Lines, candidates: Candidates, config: Config) -> BoolArray:
    """Candidates that join the inliers if the one before them has joined, (C,) bool.

    They continue a line that is longer and flatter than an obstacle, or their line starts
    at a slope break (see `starts_at_slope_break`).
    """
    growth = config.growth
    is_long = np.diff(lines.start) >= growth.min_line_size
    continued = ((np.abs(lines.slope) <= growth.max_line_slope) & is_long)[lines.line]
    continued[lines.start[:-1]] = False
    at_break = starts_at_slope_break(lines, candidates, config)
    result: BoolArray = continued | at_break[lines.line]
    return result


def starts_at_slope_break(lines: Lines, candidates: Candidates, config: Config) -> BoolArray:
    """Lines that intersect the one before them in the gap between the two, (Q,) bool.

    Where the slope of the ground changes, as at the start of a ramp between two rings, the
    extended lines before and after intersect between the last candidate of the one and the
    first of the other. At a step they do not: an obstacle's line passes over, or starts
    over, the ground's. Parameters are those of `candidates_on_lines`.
    """
    tolerance, max_slope = config.lines.offset_tolerance, config.growth.max_line_slope
    first, behind = lines.start[:-1], lines.start[1:]
    size = behind - first
    steep = np.abs(np.nan_to_num(lines.slope, nan=np.inf)) > max_slope
    is_long = lines.extent(candidates) >= config.growth.min_bend_extent
    possible = (size >= MIN_BREAK_CANDIDATES) & is_long & ~steep & (first > 0)
    chosen = np.flatnonzero(possible)
    segment = candidates.segment
    chosen = chosen[segment[first[chosen]] == segment[first[chosen] - 1]]
    start, number = first[chosen], size[chosen]
    last = start - 1
    r, z = candidates.r, candidates.z
    mean_r = np.add.reduceat(r, first)[chosen] / number
    mean_z = np.add.reduceat(z, first)[chosen] / number
    over_last = mean_z + lines.slope[chosen] * (r[last] - mean_r) - z[last]
    slope_before = lines.slope[lines.line[last]]
    # A single candidate, or one above the other, has no usable slope: level.
    slope_before = np.where(np.abs(slope_before) <= max_slope, slope_before, 0.0)
    over_line = z[start] - (z[last] + slope_before * (r[start] - r[last]))
    upwards = (over_last <= tolerance) & (over_line >= -tolerance)
    downwards = (over_last >= -tolerance) & (over_line <= tolerance)
    result = np.zeros(len(size), dtype=np.bool_)
    result[chosen] = upwards | downwards
    return result
