"""Compiled twin of `gp_ground_seg.core.pipeline.lines`: candidates to lines and pseudo-inputs."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.compiled.sections import numbers_of
from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    Faces,
    FloatArray,
    Lines,
    PseudoInputs,
)
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import (
    Config,
    GrowthConfig,
    LatentConfig,
    LengthScaleConfig,
    LinesConfig,
)
from gp_ground_seg.core.pipeline import lines as plain
from gp_ground_seg.core.pipeline.lines import MIN_BREAK_CANDIDATES

_deming_slope = jit()(plain.deming_slope)


def find_lines(
    candidates: Candidates, faces: Faces, config: Config
) -> tuple[Candidates, Lines, PseudoInputs, BoolArray]:
    """Do what `gp_ground_seg.core.pipeline.lines.find_lines` does."""
    tolerances = numbers_of(config.lines)
    room = Candidates.room(len(candidates.r), len(candidates.offsets) - 1)
    n = _keep_visible(candidates, faces.has_occluded_base, room)
    kept = room.first(n)
    lines = Lines(np.empty(n, np.int64), np.empty(n), np.empty(n + 1, np.int64))
    n_lines = _extract_lines(kept, tolerances, lines)
    lines = Lines(lines.line, lines.slope[:n_lines], lines.start[: n_lines + 1])
    pseudo = PseudoInputs(np.empty(n), np.empty(n), np.empty_like(kept.offsets))
    latent, limits = numbers_of(config.latent), numbers_of(config.length_scale)
    p = _select_pseudo_inputs(kept, lines, latent, limits, pseudo)
    pseudo = pseudo._replace(r_bar=pseudo.r_bar[:p], log_extent=pseudo.log_extent[:p])
    continues_line = np.empty(n, np.bool_)
    _mark_candidates_on_lines(kept, lines, tolerances, numbers_of(config.growth), continues_line)
    return kept, lines, pseudo, continues_line


@jit(entry=True)
def _keep_visible(candidates: Candidates, has_occluded_base: BoolArray, kept: Candidates) -> int:
    """Leave out candidates in tiles where the base of a face is occluded; return their number."""
    n = 0
    kept.offsets[0] = 0
    for m in range(len(candidates.offsets) - 1):
        for c in range(candidates.offsets[m], candidates.offsets[m + 1]):
            if not has_occluded_base[candidates.tile[c]]:
                kept.r[n], kept.z[n] = candidates.r[c], candidates.z[c]
                kept.density[n] = candidates.density[c]
                kept.bin[n], kept.tile[n] = candidates.bin[c], candidates.tile[c]
                n += 1
        kept.offsets[m + 1] = n
    return n


@jit(entry=True)
def _extract_lines(candidates: Candidates, config: LinesConfig, lines: Lines) -> int:
    """Cut the candidates into lines; return their number."""
    r, z, density, offsets = candidates.r, candidates.z, candidates.density, candidates.offsets
    line, slopes, start = lines.line, lines.slope, lines.start
    tangent = math.tan(config.slope_tolerance)
    square_distance = config.max_line_distance * config.max_line_distance
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
                    r[j] - r[j - 1] > config.max_gap + config.max_gap_growth * r[j]
                    or own_density > config.max_density_ratio * last_density
                    or last_density > config.max_density_ratio * own_density
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
                new_slope = _deming_slope(
                    sum_rr - n * mean_r * mean_r,
                    sum_zz - n * mean_z * mean_z,
                    sum_rz - n * mean_r * mean_z,
                    config.error_ratio,
                )
                if n > 2:
                    moved = mean_z + new_slope * (dr - mean_r) - expected
                    if abs(moved) > config.offset_tolerance or _differs_in_direction(
                        slope, new_slope, config.slope_tolerance, tangent
                    ):
                        break
                slope = new_slope
                line[j] = current
                j += 1
            slopes[current] = slope
            current += 1
            i = j
    start[current] = len(r)
    return current


@jit()
def _differs_in_direction(
    slope: float, new_slope: float, tolerance: float, tangent: float
) -> bool:
    """Whether two lines differ in direction by more than `tolerance`, of which `tangent` is."""
    along = 1.0 + slope * new_slope
    if math.isfinite(along):
        return along <= 0.0 or abs(new_slope - slope) > tangent * along
    return abs(math.atan(new_slope) - math.atan(slope)) > tolerance


@jit(entry=True)
def _select_pseudo_inputs(
    candidates: Candidates,
    lines: Lines,
    latent: LatentConfig,
    limits: LengthScaleConfig,
    pseudo: PseudoInputs,
) -> int:
    """Select pseudo-inputs; return their number, at most that of the candidates."""
    r, start = candidates.r, lines.start
    r_bar, offsets = pseudo.r_bar, pseudo.offsets
    log_shortest = math.log(limits.min)
    m = 0
    p = 0
    for q in range(len(start) - 1):
        first = start[q]
        while candidates.offsets[m] <= first:
            offsets[m] = p
            m += 1
        size = start[q + 1] - first
        extent = r[first + size - 1] - r[first]
        log_extent = log_shortest
        if extent > limits.min:
            log_extent = math.log(min(extent, limits.max))
        number = max(int(np.rint(size / latent.candidates_per_pseudo_input)), 1)
        for rank in range(number):
            r_bar[p] = r[first + (size * (2 * rank + 1)) // (2 * number)]
            pseudo.log_extent[p] = log_extent
            p += 1
    for k in range(m, len(offsets)):
        offsets[k] = p
    return p


@jit(entry=True)
def _mark_candidates_on_lines(
    candidates: Candidates,
    lines: Lines,
    config: LinesConfig,
    growth: GrowthConfig,
    continues_line: BoolArray,
) -> None:
    """Mark the candidates that join the inliers if the one before them has joined."""
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    start, slope = lines.start, lines.slope
    m = 0
    for q in range(len(slope)):
        first, stop = start[q], start[q + 1]
        while offsets[m] < first:
            m += 1
        is_flat = abs(slope[q]) <= growth.max_line_slope
        at_break = False
        is_long = stop - first >= MIN_BREAK_CANDIDATES
        is_long = is_long and r[stop - 1] - r[first] >= growth.min_bend_extent
        if is_flat and is_long and offsets[m] != first:
            at_break = _meets_line_before(
                first,
                stop,
                r,
                z,
                slope[q - 1],
                slope[q],
                config.offset_tolerance,
                growth.max_line_slope,
            )
        continues_line[first] = at_break
        for c in range(first + 1, stop):
            continues_line[c] = at_break or (is_flat and stop - first >= growth.min_line_size)


@jit()
def _meets_line_before(
    first: int,
    stop: int,
    r: FloatArray,
    z: FloatArray,
    before: float,
    slope: float,
    offset_tolerance: float,
    max_line_slope: float,
) -> bool:
    """Whether the line and that before it intersect between them."""
    mean_r, mean_z = 0.0, 0.0
    for c in range(first, stop):
        mean_r += r[c] / (stop - first)
        mean_z += z[c] / (stop - first)
    last = first - 1
    if not abs(before) <= max_line_slope:
        before = 0.0
    over_last = mean_z + slope * (r[last] - mean_r) - z[last]
    over_line = z[first] - (z[last] + before * (r[first] - r[last]))
    tolerance = offset_tolerance
    upwards = over_last <= tolerance and over_line >= -tolerance
    downwards = over_last >= -tolerance and over_line <= tolerance
    meets: bool = upwards or downwards
    return meets
