"""Pseudo-inputs of the latent process, from the extracted lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gp_ground_seg.compiled import compiled
from gp_ground_seg.config import Config, LatentConfig
from gp_ground_seg.line_extraction import Lines
from gp_ground_seg.polar_grid import Candidates, FloatArray, IntArray

N_CLASSES = 9
"""Surface classes: flat, sloped, steep times short, medium, long."""


@dataclass(frozen=True)
class PseudoInputs:
    """Pseudo-inputs of all segments; those of one surface class share a log length-scale.

    Attributes
    ----------
    r_bar : (P,) float64
        Ranges [m], increasing in each segment.
    surface_class : (P,) int64
        Surface class, 0 to `N_CLASSES` - 1.
    offsets : (M + 1,) int64
        Pseudo-inputs of segment m are ``offsets[m]:offsets[m + 1]``.
    first_guess : (N_CLASSES,) float64
        Mean log extent of the lines of each class [log m].
    """

    r_bar: FloatArray
    surface_class: IntArray
    offsets: IntArray
    first_guess: FloatArray


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
    size = np.diff(lines.start)
    wanted = np.rint(size / config.latent.candidates_per_pseudo_input).astype(np.int64)
    number = np.maximum(wanted, 1)
    extent = lines.extent(candidates)
    line_class = classify_lines(lines.slope, extent, config.latent)
    limits = config.length_scale
    log_extent = np.log(np.clip(extent, limits.min, limits.max))
    count = np.bincount(line_class, minlength=N_CLASSES)
    total = np.bincount(line_class, weights=log_extent, minlength=N_CLASSES)
    empty = log_extent.mean() if len(log_extent) else np.log(limits.min)
    position, line = _spread(lines.start, number, int(number.sum()))
    return PseudoInputs(
        r_bar=candidates.r[position],
        surface_class=line_class[line],
        offsets=np.searchsorted(position, candidates.offsets),
        first_guess=np.where(count > 0, total / np.maximum(count, 1), empty),
    )


@compiled
def _spread(start: IntArray, number: IntArray, n_positions: int) -> tuple[IntArray, IntArray]:
    """Candidate and line of each pseudo-input."""
    position = np.empty(n_positions, dtype=np.int64)
    line = np.empty(n_positions, dtype=np.int64)
    p = 0
    for q in range(len(number)):
        size = start[q + 1] - start[q]
        for rank in range(number[q]):
            # The middle of each of `number` equal shares of the line's candidates.
            position[p] = start[q] + (size * (2 * rank + 1)) // (2 * number[q])
            line[p] = q
            p += 1
    return position, line
