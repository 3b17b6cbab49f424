"""Stage 4: lines through the candidates of a segment, and pseudo-inputs on them.

numba compiles `trace` and its loops; in numpy `_trace_at_once` has none over candidates.
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
    IntArray,
    Lines,
    PseudoInputs,
    Values,
)
from gp_ground_seg.core.jit import choose, shared
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
STEEPEST = 1e150
"""Slope over which all count as vertical; its square is finite."""
POINT = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, math.nan
"""Line of one point, see `with_next`."""
WIDE = 14.0
"""Width over which candidates of neighbouring segments form one surface on land [m]. With 11 m
more of hills is found, and more objects along real streets are taken for it."""
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
    lines, pseudo-inputs, how the ground goes on behind each, and which are on land (`find_land`).
    `trace_lines` is `trace`, compiled.
    """
    candidates = candidates.where(~faces.has_occluded_base[candidates.tile])
    n = len(candidates.r)
    lines = Lines(np.empty(n, np.int64), np.empty(n), np.empty(n + 1, np.int64))
    onward, land, (line, kind) = np.empty(n), np.empty(n, np.bool_), np.zeros((2, n), np.int64)
    pseudo = PseudoInputs(np.empty(n), np.empty(n), candidates.offsets, line, kind)
    groups: Any = tuple(
        map(numbers_of, (config.lines, config.growth, config.latent, config.length_scale))
    )
    is_start = find_starts(candidates, config.lines)
    n_lines, n = (trace_lines or _trace_at_once)(
        candidates, is_start, groups, lines, pseudo, onward, land
    )
    lines = Lines(lines.line, lines.slope[:n_lines], lines.start[: n_lines + 1])
    offsets = np.searchsorted(lines.start[line[:n]], candidates.offsets)
    pseudo = PseudoInputs(pseudo.r_bar[:n], pseudo.log_extent[:n], offsets, line[:n], kind[:n])
    if config.learning.length_scale == 'classes':
        pseudo = shared_by_class(lines, pseudo, config.length_scale)
    return candidates, lines, pseudo, onward, land


def _trace_at_once(
    candidates: Candidates,
    is_start: BoolArray,
    groups: Groups,
    lines: Lines,
    pseudo: PseudoInputs,
    onward: FloatArray,
    land: BoolArray,
) -> tuple[int, int]:
    """Do what `trace` does, at once for all segments."""
    tolerances, growth, latent, limits = groups
    r, z = candidates.r, candidates.z
    slope = _line_slopes(r, z, is_start, tolerances)
    start = np.flatnonzero(is_start)
    n_lines, size = len(slope), np.diff(start)
    lines.line[:] = np.repeat(np.arange(n_lines), size)
    lines.slope[:n_lines], lines.start[: n_lines + 1] = slope, start
    onward[:] = _onward(r, z, candidates.offsets[1:][candidates.segment], growth)
    land[:] = _is_land(candidates, growth)
    number = np.maximum(np.rint(size / latent.candidates_per_pseudo_input).astype(np.int64), 1)
    line = np.repeat(np.arange(n_lines), number)
    n, rank = len(line), np.arange(len(line)) - (np.cumsum(number) - number)[line]
    place = start[line] + place_of(rank, number[line], size[line])
    extent = np.clip(r[start[1:] - 1] - r[start[:-1]], limits.min, limits.max)
    pseudo.r_bar[:n], pseudo.log_extent[:n], pseudo.line[:n] = r[place], np.log(extent)[line], line
    return n_lines, n


@np.errstate(over='ignore', invalid='ignore')  # the square of 1e200 m; infinite slopes
def _line_slopes(
    r: FloatArray, z: FloatArray, is_start: BoolArray, tolerances: LinesConfig
) -> FloatArray:
    """Slope of each line, (Q,); the first candidates of all are set in `is_start` (C + 1,).

    Stretches between those set before, see `find_starts`, grow together, the longest first.
    """
    tangent = math.tan(tolerances.slope_tolerance)
    stretch = np.flatnonzero(is_start)
    size = np.diff(stretch)
    order = np.argsort(-size, kind='stable')
    stretch, size = stretch[order], size[order]
    first, slope = stretch.copy(), np.full(len(r), np.nan)
    fresh = np.array(POINT)[:, None]
    fit = np.repeat(fresh, len(first), axis=1)
    for step in range(1, size.max(initial=0)):
        n = np.searchsorted(-size, -step)
        new, first, fit = stretch[:n] + step, first[:n], fit[:, :n]
        is_critical, longer = with_next(
            fit, r[new] - r[first], z[new] - z[first], tolerances, tangent
        )
        is_start[new] = is_critical
        fit, first = np.where(is_critical, fresh, longer), np.where(is_critical, new, first)
        slope[first] = fit[-1]
    return slope[is_start[:-1]]


def _is_land(candidates: Candidates, growth: GrowthConfig) -> BoolArray:
    """Do what `find_land` does."""
    r, z, n = candidates.r, candidates.z, len(candidates.r)
    segment, n_segments = candidates.segment, candidates.n_segments
    arc, number = 2.0 * math.pi / n_segments * r, np.zeros(n)
    # Segments first, then ranges: what is nearest in the next segment is nearest of all.
    share = 0.4 * r / r.max(initial=1.0)
    middle = segment[1:] - 0.5 * np.diff(segment) + 0.5 * (share[1:] + share[:-1])
    for side in (-1, 1):
        beside = (segment + side) % n_segments
        nearest = np.searchsorted(middle, beside + share)
        goes_on = goes_aside(r[nearest] - r, z[nearest] - z, arc, growth.max_slope)
        # Where steps lead to, or n, and how many. Each round doubles them.
        at = np.append(np.where(goes_on & (segment[nearest] == beside), nearest, n), n)
        steps = (at < n).astype(np.int64)
        for _ in range(n_segments.bit_length()):
            steps, at = steps + steps[at], at[at]
        number += steps[:-1]
    return np.minimum(number, n_segments) * arc >= WIDE


def _onward(r: FloatArray, z: FloatArray, stop: IntArray, growth: GrowthConfig) -> FloatArray:
    """Do what `find_onward` does; `stop` (C,) is where the segment of each candidate ends."""
    far, r_padded = np.minimum(np.arange(2, len(r) + 2), stop), np.append(r, np.inf)
    while (is_near := (far < stop) & (r_padded[far] - r < growth.min_rise_extent)).any():
        far += is_near
    is_end = np.append(~is_walkable(np.diff(z), np.diff(r), growth.max_slope), True)
    is_end[stop - 1] = True
    # The last candidate that walkable steps lead to.
    end = np.flatnonzero(is_end)[np.cumsum(is_end) - is_end]
    onward = np.full(len(r), -np.inf)
    c = np.flatnonzero(far <= end)
    onward[c] = slope_behind(z[far[c]] - z[c], r[far[c]] - r[c], growth.max_slope)
    return onward


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


def find_starts(candidates: Candidates, tolerances: LinesConfig) -> BoolArray:
    """Whether a line starts at each candidate, whatever is before, and at the end, (C + 1,).

    It is the first of a segment, or a gap lies before it, or a sharp change of the density.
    """
    r, density, ratio = candidates.r, candidates.density, tolerances.max_density_ratio
    is_start = np.zeros(len(r) + 1, np.bool_)
    is_start[candidates.offsets] = True
    is_start[1:-1] |= r[1:] - r[:-1] > tolerances.max_gap + tolerances.max_gap_growth * r[1:]
    is_denser, is_thinner = density[1:] > ratio * density[:-1], density[:-1] > ratio * density[1:]
    is_start[1:-1] |= is_denser | is_thinner
    return is_start


@shared
def trace(
    candidates: Candidates,
    is_start: BoolArray,
    groups: Groups,
    lines: Lines,
    pseudo: PseudoInputs,
    onward: FloatArray,
    land: BoolArray,
) -> tuple[int, int]:
    """Fill the last three; return the number of lines, and that of pseudo-inputs.

    There is room for as many as there are candidates; offsets and kinds are not set. For
    `is_start` see `find_starts`.
    """
    tolerances, growth, latent, limits = groups
    n_lines = extract_lines(candidates, is_start, tolerances, lines)
    find_onward(candidates, growth, onward)
    find_land(candidates, growth, land)
    return n_lines, select_pseudo_inputs(candidates, lines, n_lines, latent, limits, pseudo)


@shared
def extract_lines(
    candidates: Candidates, is_start: BoolArray, tolerances: LinesConfig, lines: Lines
) -> int:
    """Cut each segment's candidates into lines; return their number.

    Paper, section III-D and Algorithm 1. A line grows over the candidates in order of range until
    the next one makes a critical point: a gap, a change of slope or of height at the new point, a
    distance from the line that is too large, or a sharp change of the vertical density. The next
    line starts there, independent of the one before.
    """
    r, z, tangent = candidates.r, candidates.z, math.tan(tolerances.slope_tolerance)
    fit, first, n_lines = POINT, 0, 0
    for c in range(len(r)):
        is_critical, longer = with_next(fit, r[c] - r[first], z[c] - z[first], tolerances, tangent)
        if is_start[c] or is_critical:
            lines.start[n_lines], longer, first = c, POINT, c
            n_lines += 1
        fit = longer
        lines.line[c], lines.slope[n_lines - 1] = n_lines - 1, fit[-1]
    lines.start[n_lines] = len(r)
    return n_lines


@shared
def with_next(
    fit: Values, dr: Values, dz: Values, tolerances: LinesConfig, tangent: float
) -> tuple[Values, Values]:
    """Whether the next point makes a critical point of a line, and the line with it.

    A line is the number of its points, sums over them, and its slope, NaN of one point (see
    `POINT`). Coordinates relative to its first point, as `dr` and `dz` are, keep their digits.
    """
    n, sum_r, sum_z, sum_rr, sum_zz, sum_rz, slope = fit
    expected = sum_z / n + slope * (dr - sum_r / n)
    missed, distance = dz - expected, tolerances.max_line_distance
    is_far = missed * missed > distance * distance * (1.0 + slope * slope)
    n, sum_r, sum_z = n + 1.0, sum_r + dr, sum_z + dz
    sum_rr, sum_zz, sum_rz = sum_rr + dr * dr, sum_zz + dz * dz, sum_rz + dr * dz
    mean_r, mean_z = sum_r / n, sum_z / n
    s_rr, s_zz = sum_rr - sum_r * mean_r, sum_zz - sum_z * mean_z
    s_rz = sum_rz - sum_r * mean_z
    new_slope = deming_slope(s_rr, s_zz, s_rz, tolerances.error_ratio)
    # NaN, which no comparison holds of, where the line is one point.
    moved = mean_z + new_slope * (dr - mean_r) - expected
    is_bent = (abs(moved) > tolerances.offset_tolerance) | differs_in_direction(
        slope, new_slope, tangent
    )
    return is_far | is_bent, (n, sum_r, sum_z, sum_rr, sum_zz, sum_rz, new_slope)


@shared
def deming_slope(s_rr: Values, s_zz: Values, s_rz: Values, error_ratio: float) -> Values:
    """Slope dz/dr of the line with errors in both variables: Deming's regression.

    The paper's distance-oriented regression (section III-D).

    The first three are sums of squares and products about the mean [m^2], `error_ratio` is the
    variance of the height error over that of the range error. Infinite for a vertical line.
    """
    difference, twice = s_zz - error_ratio * s_rr, 2.0 * s_rz
    part = error_ratio * twice
    larger = abs(difference) + np.sqrt(difference * difference + part * twice)
    # Two equal forms; each is free of cancellation where it is used.
    is_steep = difference > 0.0
    numerator, denominator = choose(is_steep, larger, part), choose(is_steep, twice, larger)
    is_vertical = (denominator == 0.0) & is_steep
    slope = numerator / choose(denominator == 0.0, 1.0, denominator)
    return choose(is_vertical, math.inf, slope)


@shared
def differs_in_direction(slope: Values, new_slope: Values, tangent: float) -> Values:
    """Whether lines of these slopes differ in direction by an angle of more than this tangent."""
    # The tangent of the difference of two angles follows from their tangents, which saves
    # an arctangent for each candidate. Their product is finite.
    slope = np.minimum(np.maximum(slope, -STEEPEST), STEEPEST)
    new_slope = np.minimum(np.maximum(new_slope, -STEEPEST), STEEPEST)
    along = 1.0 + slope * new_slope
    return (along <= 0.0) | (abs(new_slope - slope) > tangent * along)


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
    r, start, p = candidates.r, lines.start, 0
    for q in range(n_lines):
        first, size = start[q], start[q + 1] - start[q]
        extent = r[first + size - 1] - r[first]
        log_extent = math.log(min(max(extent, limits.min), limits.max))
        number = max(round(size / latent.candidates_per_pseudo_input), 1)
        for rank in range(number):
            pseudo.r_bar[p] = r[first + place_of(rank, number, size)]
            pseudo.log_extent[p] = log_extent
            pseudo.line[p] = q
            p += 1
    return p


@shared
def place_of(rank: Values, number: Values, size: Values) -> Values:
    """Place of the middle of one of `number` equal shares of the `size` candidates of a line."""
    return size * (2 * rank + 1) // (2 * number)


@shared
def find_onward(candidates: Candidates, growth: GrowthConfig, onward: FloatArray) -> None:
    """Slope with which the ground goes on behind each candidate, into `onward` (C,).

    Over at least two more candidates and ``growth.min_rise_extent``, with no step between two;
    -inf where it does not, or the segment ends before that shows.
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
            if far < step:
                onward[c] = slope_behind(z[far] - z[c], r[far] - r[c], growth.max_slope)


@shared
def is_walkable(rise: Values, distance: Values, max_slope: Values) -> Values:
    """Whether ground rises or falls by so much over a distance [m]: no more than a slope."""
    return abs(rise) <= max_slope * (distance + UNEVEN)


@shared
def slope_behind(rise: Values, distance: Values, max_slope: Values) -> Values:
    """Slope with which ground goes on that rises by so much over a distance [m]."""
    return (rise + max_slope * UNEVEN) / distance


@shared
def goes_aside(apart: Values, rise: Values, arc: Values, max_slope: float) -> Values:
    """Whether ground can reach a candidate one segment on, which is so much farther and higher."""
    return (abs(apart) <= arc) & is_walkable(rise, arc + abs(apart), max_slope)


@shared
def find_land(candidates: Candidates, growth: GrowthConfig, land: BoolArray) -> None:
    """Set in `land` (C,) whether a candidate is of a surface too wide for an object: `WIDE` [m].

    The surface continues in the nearest candidate of a neighbouring segment if their ranges differ
    by no more than the arc between them, and their heights by no more than those of ground.
    """
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    n_segments, number = len(offsets) - 1, np.zeros((2, len(r)))
    angle, onto = 2.0 * math.pi / n_segments, np.empty(len(r), np.int64)
    for side in range(2):
        for m in range(n_segments):
            beside = (m + 2 * side - 1) % n_segments
            near, stop = offsets[beside], offsets[beside + 1]
            for c in range(offsets[m], offsets[m + 1]):
                while near + 1 < stop and abs(r[near + 1] - r[c]) < abs(r[near] - r[c]):
                    near += 1
                onto[c] = -1
                if near < stop and goes_aside(
                    r[near] - r[c], z[near] - z[c], angle * r[c], growth.max_slope
                ):
                    onto[c] = near
        # Twice around: the ring of segments has no end.
        for k in range(2 * n_segments):
            m = (k if side == 0 else -k) % n_segments
            for c in range(offsets[m], offsets[m + 1]):
                number[side, c] = number[side, onto[c]] + 1.0 if onto[c] >= 0 else 0.0
    for c in range(len(r)):
        land[c] = min(number[0, c] + number[1, c], n_segments) * angle * r[c] >= WIDE
