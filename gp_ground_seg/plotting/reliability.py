"""Reliability diagram: how often what is called ground with probability p is ground."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.evaluation.calibration import BIN_EDGES, Calibration
from gp_ground_seg.plotting.canvas import new_figure

POOLED_COLOUR = '#0072B2'
SEQUENCE_COLOUR = '#9AA1A9'
IDEAL_COLOUR = '#3B4046'
BAR_COLOUR = '#BFD7EA'
# Inches: the square, the bars below it, and what is around them.
SQUARE, COUNTS, GAP, LEFT, RIGHT, BOTTOM, TITLE = 5.4, 1.4, 0.15, 0.8, 0.2, 0.6, 0.5
LEAST_POINTS = 20
"""Bins with fewer points than this are left out of the lines: their shares say nothing."""


def plot_reliability(
    pooled: Calibration, sequences: Mapping[str, Calibration], path: str | Path, title: str = ''
) -> None:
    """Draw share of ground over probability, points per bin below, as a PNG.

    Parameters
    ----------
    pooled : Calibration
        Of all frames.
    sequences : mapping of str to Calibration
        By sequence; drawn thin if there is more than one.
    path : str or Path
        File to write, replaced if it exists.
    title : str
        Line above.

    Raises
    ------
    PointCloudError
        If there is no point to draw.
    MissingDependencyError
        If matplotlib is not installed.
    DataError
        If the file cannot be written.
    """
    if not pooled.n_total:
        raise PointCloudError('reliability diagram: no scored point has a probability')
    height = TITLE + SQUARE + GAP + COUNTS + BOTTOM
    width = LEFT + SQUARE + RIGHT
    figure, canvas = new_figure(width, height)
    left, across = LEFT / width, SQUARE / width
    upper = figure.add_axes((left, (BOTTOM + COUNTS + GAP) / height, across, SQUARE / height))
    lower = figure.add_axes((left, BOTTOM / height, across, COUNTS / height), sharex=upper)
    upper.tick_params(labelbottom=False)
    upper.plot([0, 1], [0, 1], color=IDEAL_COLOUR, linestyle='--', linewidth=1, label='ideal')
    for k, one in enumerate(sequences.values() if len(sequences) > 1 else ()):
        label = 'one sequence' if k == 0 else None
        _draw_line(upper, one, color=SEQUENCE_COLOUR, linewidth=1, marker='.', label=label)
    _draw_line(upper, pooled, color=POOLED_COLOUR, linewidth=2, marker='o', label='all')
    upper.set_xlim(0.0, 1.0)
    upper.set_ylim(0.0, 1.0)
    upper.set_ylabel('share that is ground')
    upper.set_title(title, fontsize=12, fontweight='bold', parse_math=False)
    upper.grid(color='#E3E6E9', linewidth=0.8)
    upper.set_axisbelow(True)
    text = f'ECE {pooled.ece:.4f}\nBrier {pooled.brier:.4f}'
    upper.text(0.97, 0.03, text, ha='right', va='bottom', fontsize=11)
    upper.legend(loc='lower right', bbox_to_anchor=(1.0, 0.1), frameon=False)
    _draw_counts(lower, pooled)
    with staged_file(path, force=True) as part:
        canvas.print_png(str(part))


def _draw_line(axes: Any, one: Calibration, **style: Any) -> None:
    enough = one.n_points >= LEAST_POINTS
    axes.plot(one.mean_p[enough], one.share_ground[enough], markersize=6, clip_on=False, **style)


def _draw_counts(axes: Any, pooled: Calibration) -> None:
    share = 100.0 * pooled.n_points / pooled.n_total
    width = np.diff(BIN_EDGES)
    axes.bar(
        BIN_EDGES[:-1], share, width, align='edge', color=BAR_COLOUR, edgecolor='white'
    )  # fmt: skip
    axes.set_yscale('log')
    axes.set_ylim(min(0.1, 0.7 * share[share > 0].min()), 100.0)
    axes.set_yticks([0.1, 1.0, 10.0, 100.0], ['0.1', '1', '10', '100'])
    axes.minorticks_off()
    axes.set_ylabel('points [%]')
    axes.set_xlabel('probability of ground, p_ground')
