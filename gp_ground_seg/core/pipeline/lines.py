"""Stage 4: lines through the candidates of a segment, and pseudo-inputs on them.

The loops are those of both backends: numba compiles `trace` with all that it calls.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    Faces,
    FloatArray,
    Lines,
    PseudoInputs,
    Values,
)
from gp_ground_seg.core.jit import shared
from gp_ground_seg.core.parameters.config import (
    Config,
    GrowthConfig,
    LatentConfig,
    LengthScaleConfig,
    LinesConfig,
)
from gp_ground_seg.core.parameters.schema import numbers_of

UNEVEN = 0.25
"""Distance that is added to that over which the ground rises, as it is not smooth [m]."""
N_CLASSES = 9
"""Classes of lines that share a length-scale."""

Groups = tuple[LinesConfig, GrowthConfig, LatentConfig, LengthScaleConfig]
"""Parameters that lines and pseudo-inputs depend on."""


def find_lines(
    candidates: Candidates,
    faces: Faces,
    config: Config,
    trace_lines: Callable[..., tuple[int, int]] | None = None,
) -> tuple[Candidates, Lines, PseudoInputs, FloatArray, BoolArray]:
    """Lines through the candidates that show ground, and what follows from the lines.

    The lowest point of a face with occluded base is no candidate. Returns the candidates kept,
    lines, pseudo-inputs, how the ground goes on behind each, and which are in faces.
    `trace_lines` is `trace`, compiled or not.
    """
    candidates = candidates.where(~faces.has_occluded_base[candidates.tile])
    n = len(candidates.r)
    lines = Lines(np.empty(n, np.int64), np.empty(n), np.empty(n + 1, np.int64))
    offsets = np.empty(len(candidates.offsets), np.int64)
    line, kind = np.empty((2, n), np.int64)
    pseudo = PseudoInputs(np.empty(n), np.empty(n), offsets, line, kind)
    onward = np.empty(n)
    groups: Any = tuple(
        map(numbers_of, (config.lines, config.growth, config.latent, config.length_scale))
    )
    is_break = find_breaks(candidates.r, candidates.density, config.lines)
    n_lines, n_pseudo = (trace_lines or _trace_lists)(
        candidates, is_break, groups, lines, pseudo, onward
    )
    lines = Lines(lines.line, lines.slope[:n_lines], lines.start[: n_lines + 1])
    n = n_pseudo
    pseudo = PseudoInputs(pseudo.r_bar[:n], pseudo.log_extent[:n], offsets, line[:n], kind[:n])
    if config.learning.length_scale == 'classes':
        pseudo = shared_by_class(lines, pseudo, config.length_scale)
    return candidates, lines, pseudo, onward, faces.is_face[candidates.tile]


def _trace_lists(
    candidates: Candidates, is_break: BoolArray, groups: Groups, *results: Any
) -> tuple[int, int]:
    """Do what `trace` does: plain Python reads lists, and writes views, faster than arrays."""
    lines, pseudo, onward = results
    *inputs, breaks = (column.tolist() for column in (*candidates, is_break))
    views: Any = [memoryview(array) for array in (*lines, *pseudo, onward)]
    results = Lines(*views[:3]), PseudoInputs(*views[3:8]), views[8]
    return trace(Candidates(*inputs), breaks, groups, *results)


def class_middles(limits: LengthScaleConfig) -> FloatArray:
    """Log length in the middle of each class of lines, (N_CLASSES,) [log m].

    The three classes of length are equally wide on a log scale between ``length_scale.min`` and
    ``length_scale.max``; each has three of slope.
    """
    edges = np.linspace(math.log(limits.min), math.log(limits.max), 7)
    return np.repeat(edges[1::2], N_CLASSES // 3).astype(np.float64)


def shared_by_class(lines: Lines, pseudo: PseudoInputs, limits: LengthScaleConfig) -> PseudoInputs:
    """Pseudo-inputs of which those on lines of one class share the first guess.

    "All segments share L-bar" (paper, section III-E), though each has other lines. The classes
    are those of `class_middles`, and by slope: the line falls, is flat up to
    ``length_scale.flat_gradient``, or rises.
    """
    slope, share = lines.slope[pseudo.line], pseudo.log_extent - math.log(limits.min)
    by_length = (3.0 * share / math.log(limits.max / limits.min)).astype(np.int64)
    # A line of one point has no slope: it is flat.
    by_slope = (
        1 + (slope > limits.flat_gradient) - (slope < -limits.flat_gradient).astype(np.int64)
    )
    kind = 3 * np.minimum(by_length, 2) + by_slope
    return pseudo._replace(log_extent=class_middles(limits)[kind], kind=kind)


def find_breaks(r: FloatArray, density: FloatArray, tolerances: LinesConfig) -> BoolArray:
    """Whether a gap, or a sharp change of the density, lies before each candidate, (C,)."""
    breaks, ratio = np.zeros(len(r), np.bool_), tolerances.max_density_ratio
    breaks[1:] = r[1:] - r[:-1] > tolerances.max_gap + tolerances.max_gap_growth * r[1:]
    breaks[1:] |= density[1:] > ratio * density[:-1]
    breaks[1:] |= density[:-1] > ratio * density[1:]
    return breaks


@shared
def trace(
    candidates: Candidates,
    is_break: BoolArray,
    groups: Groups,
    lines: Lines,
    pseudo: PseudoInputs,
    onward: FloatArray,
) -> tuple[int, int]:
    """Fill the last three; return the number of lines, and that of pseudo-inputs.

    There is room for as many as there are candidates. For `is_break` see `find_breaks`.
    """
    tolerances, growth, latent, limits = groups
    n_lines = extract_lines(candidates, is_break, tolerances, lines)
    find_onward(candidates, growth, onward)
    return n_lines, select_pseudo_inputs(candidates, lines, n_lines, latent, limits, pseudo)


@shared
def extract_lines(
    candidates: Candidates, is_break: BoolArray, tolerances: LinesConfig, lines: Lines
) -> int:
    """Cut each segment's candidates into lines; return their number.

    Paper, section III-D and Algorithm 1. A line grows over the candidates in order of range until
    the next one makes a critical point: a gap, a change of slope or of height at the new point, a
    distance from the line that is too large, or a sharp change of the vertical density. The next
    line starts there, independent of the one before.
    """
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    tangent = math.tan(tolerances.slope_tolerance)
    n_lines = 0
    for m in range(len(offsets) - 1):
        first, stop = offsets[m], offsets[m + 1]
        while first < stop:
            behind, slope = grow_line(first, stop, r, z, is_break, tolerances, tangent)
            lines.start[n_lines], lines.slope[n_lines] = first, slope
            for c in range(first, behind):
                lines.line[c] = n_lines
            n_lines += 1
            first = behind
    lines.start[n_lines] = len(r)
    return n_lines


@shared
def grow_line(
    first: int,
    stop: int,
    r: FloatArray,
    z: FloatArray,
    is_break: BoolArray,
    tolerances: LinesConfig,
    tangent: float,
) -> tuple[int, float]:
    """Candidate behind the line from `first`, at most `stop`, and the line's slope.

    `tangent` is that of ``tolerances.slope_tolerance``.
    """
    square_distance = tolerances.max_line_distance * tolerances.max_line_distance
    # Sums relative to the first point of the line keep their digits.
    sum_r = sum_z = sum_rr = sum_zz = sum_rz = mean_r = mean_z = 0.0
    slope, n = math.nan, 1
    for j in range(first + 1, stop):
        if is_break[j]:
            return j, slope
        dr, dz = r[j] - r[first], z[j] - z[first]
        expected = mean_z + slope * (dr - mean_r)
        missed = dz - expected
        if n > 1 and missed * missed > square_distance * (1.0 + slope * slope):
            return j, slope
        n += 1
        sum_r, sum_z = sum_r + dr, sum_z + dz
        sum_rr, sum_zz, sum_rz = sum_rr + dr * dr, sum_zz + dz * dz, sum_rz + dr * dz
        mean_r, mean_z = sum_r / n, sum_z / n
        s_rr, s_zz = sum_rr - n * mean_r * mean_r, sum_zz - n * mean_z * mean_z
        s_rz = sum_rz - n * mean_r * mean_z
        new_slope = deming_slope(s_rr, s_zz, s_rz, tolerances.error_ratio)
        if n > 2:
            moved = mean_z + new_slope * (dr - mean_r) - expected
            if abs(moved) > tolerances.offset_tolerance:
                return j, slope
            if differs_in_direction(slope, new_slope, tangent):
                return j, slope
        slope = new_slope
    return stop, slope


@shared
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


@shared
def differs_in_direction(slope: float, new_slope: float, tangent: float) -> bool:
    """Whether lines of these slopes differ in direction by an angle of more than this tangent."""
    # The tangent of the difference of two angles follows from their tangents, which saves
    # an arctangent for each candidate.
    along = 1.0 + slope * new_slope
    if math.isfinite(along):
        return along <= 0.0 or abs(new_slope - slope) > tangent * along
    return abs(math.atan(new_slope) - math.atan(slope)) > math.atan(tangent)


@shared
def select_pseudo_inputs(
    candidates: Candidates,
    lines: Lines,
    n_lines: int,
    latent: LatentConfig,
    limits: LengthScaleConfig,
    pseudo: PseudoInputs,
) -> int:
    """Spread pseudo-inputs evenly over the candidates of each line; return their number.

    Paper, section III-C. Every line gets at least one.
    """
    r, start = candidates.r, lines.start
    m = p = 0
    for q in range(n_lines):
        first, size = start[q], start[q + 1] - start[q]
        while candidates.offsets[m] <= first:
            pseudo.offsets[m] = p
            m += 1
        extent = r[first + size - 1] - r[first]
        log_extent = math.log(min(max(extent, limits.min), limits.max))
        number = max(round(size / latent.candidates_per_pseudo_input), 1)
        for rank in range(number):
            # The middle of each of `number` equal shares of the line's candidates.
            pseudo.r_bar[p] = r[first + (size * (2 * rank + 1)) // (2 * number)]
            pseudo.log_extent[p] = log_extent
            pseudo.line[p], pseudo.kind[p] = q, 0
            p += 1
    for k in range(m, len(pseudo.offsets)):
        pseudo.offsets[k] = p
    return p


@shared
def find_onward(candidates: Candidates, growth: GrowthConfig, onward: FloatArray) -> None:
    """Slope with which the ground goes on behind each candidate, into `onward` (C,).

    Over at least two more candidates and ``growth.min_rise_extent``, with no step between two;
    -inf where it does not, NaN where the segment ends before that shows.
    """
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    for m in range(len(offsets) - 1):
        # The first that is far enough from c; the first that no walkable steps from c lead to.
        far, step, stop = offsets[m], offsets[m], offsets[m + 1]
        for c in range(offsets[m], stop):
            onward[c] = -math.inf
            far, step = max(far, c + 2), max(step, c + 1)
            while far < stop and r[far] - r[c] < growth.min_rise_extent:
                far += 1
            while step < min(far + 1, stop) and is_walkable(
                z[step] - z[step - 1], r[step] - r[step - 1], growth.max_slope
            ):
                step += 1
            if step == stop <= far:
                onward[c] = math.nan
            elif far < step:
                onward[c] = (z[far] - z[c] + growth.max_slope * UNEVEN) / (r[far] - r[c])


@shared
def is_walkable(rise: Values, distance: Values, max_slope: Values) -> Values:
    """Whether ground rises or falls by so much over a distance [m]: no more than a slope."""
    return abs(rise) <= max_slope * (distance + UNEVEN)
