"""Pseudo-inputs of the latent process, from the extracted lines."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.frame import N_CLASSES, Candidates, FloatArray, IntArray, Lines, PseudoInputs
from gp_ground_seg.jit import compiled
from gp_ground_seg.parameters.config import Config, LatentConfig


def classify_lines(slope: FloatArray, extent: FloatArray, latent: LatentConfig) -> IntArray:
    """Surface class of each line, (Q,) int64.

    The paper has every segment share the log length-scales of the frame, yet
    segments differ in their lines: lines of like slope and extent are taken for
    the same kind of surface. A line of one point (slope NaN) counts as steep.

    Parameters
    ----------
    slope : (Q,) float64
        Slope dz/dr of each line.
    extent : (Q,) float64
        Horizontal extent of each line [m].
    latent : LatentConfig
        Limits between the classes.
    """
    steepness = np.where(np.isnan(slope), np.inf, np.abs(slope))
    # Comparisons, not `np.digitize`: that searches for each of them.
    result: IntArray = (extent >= latent.medium_extent).astype(np.int64)
    result += extent >= latent.long_extent
    result += 3 * (steepness >= latent.sloped_gradient)
    result += 3 * (steepness >= latent.steep_gradient)
    return result


def select_pseudo_inputs(candidates: Candidates, lines: Lines, config: Config) -> PseudoInputs:
    """Spread pseudo-inputs evenly over the candidates of each line (paper, section III-C).

    Parameters
    ----------
    candidates : Candidates
        Ground candidates.
    lines : Lines
        Lines through them; every line gets at least one pseudo-input.
    config : Config
        Number of pseudo-inputs, limits of the classes, bounds of the length-scale.
    """
    latent, limits = config.latent, config.length_scale
    size = np.diff(lines.start)
    wanted = np.rint(size / latent.candidates_per_pseudo_input).astype(np.int64)
    number = np.maximum(wanted, 1)
    extent = lines.extent(candidates)
    line_class = classify_lines(lines.slope, extent, latent)
    log_extent = np.log(np.clip(extent, limits.min, limits.max))
    count = np.bincount(line_class, minlength=N_CLASSES)
    total = np.bincount(line_class, weights=log_extent, minlength=N_CLASSES)
    empty = log_extent.mean() if len(log_extent) else np.log(limits.min)
    line = np.repeat(np.arange(len(number)), number)
    rank = np.arange(len(line)) - np.repeat(np.cumsum(number) - number, number)
    # The middle of each of `number` equal shares of the line's candidates.
    position = lines.start[line] + (size[line] * (2 * rank + 1)) // (2 * number[line])
    return PseudoInputs(
        r_bar=candidates.r[position],
        surface_class=line_class[line],
        offsets=np.searchsorted(position, candidates.offsets),
        first_guess=np.where(count > 0, total / np.maximum(count, 1), empty),
    )


@compiled
def select_compiled(
    offsets: IntArray,
    r: FloatArray,
    start: IntArray,
    slope: FloatArray,
    candidates_per_pseudo_input: float,
    medium_extent: float,
    long_extent: float,
    sloped_gradient: float,
    steep_gradient: float,
    shortest: float,
    longest: float,
) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Do what `select_pseudo_inputs` does, in one pass over the lines."""
    n_lines = len(slope)
    r_bar, surface_class = np.empty(len(r)), np.empty(len(r), dtype=np.int64)
    bar_offsets = np.empty(len(offsets), dtype=np.int64)
    count, total = np.zeros(N_CLASSES, dtype=np.int64), np.zeros(N_CLASSES)
    log_shortest = math.log(shortest)
    m = 0
    p = 0
    for q in range(n_lines):
        first = start[q]
        while offsets[m] <= first:
            bar_offsets[m] = p
            m += 1
        size = start[q + 1] - first
        extent = r[first + size - 1] - r[first]
        steepness = abs(slope[q])
        own = 0
        if extent >= medium_extent:
            own += 1
        if extent >= long_extent:
            own += 1
        # Negated: a line of one point has no slope and counts as steep.
        if not steepness < sloped_gradient:
            own += 3
        if not steepness < steep_gradient:
            own += 3
        # Many lines are of one point: their logarithm is known.
        log_extent = log_shortest if extent <= shortest else math.log(min(extent, longest))
        count[own] += 1
        total[own] += log_extent
        number = max(int(np.rint(size / candidates_per_pseudo_input)), 1)
        for rank in range(number):
            r_bar[p] = r[first + (size * (2 * rank + 1)) // (2 * number)]
            surface_class[p] = own
            p += 1
    bar_offsets[m:] = p
    empty = total.sum() / n_lines if n_lines > 0 else log_shortest
    first_guess = np.empty(N_CLASSES)
    for k in range(N_CLASSES):
        first_guess[k] = total[k] / count[k] if count[k] > 0 else empty
    return r_bar[:p], surface_class[:p], bar_offsets, first_guess
