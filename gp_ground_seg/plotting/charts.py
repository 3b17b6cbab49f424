"""Charts: time by stage, and how reliable the probability of ground is."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.frame import FloatArray, IntArray
from gp_ground_seg.plotting.style import (
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    SKY,
    VERMILION,
    VIOLET,
    new_figure,
    save,
)

STAGE_COLOURS = (BLUE, SKY, GREEN, ORANGE, VERMILION, PINK, '#B4BAC0', VIOLET)
REFERENCE_COLOUR = '#3B4046'
POOLED_COLOUR = BLUE
SEQUENCE_COLOUR = '#9AA1A9'
COUNT_COLOUR = '#BFD7EA'

# Inches: the bar chart, a bar, and what is above and below all bars.
BARS_WIDTH, BAR, AROUND = 10.0, 0.55, 1.9
# Inches: the square of the diagram, the counts and the gap below it, and the space about them.
SQUARE, COUNTS, GAP, LEFT, RIGHT, BOTTOM, TITLE = 5.4, 1.4, 0.15, 0.8, 0.2, 0.6, 0.5
MIN_POINTS = 20
"""The share of ground is not drawn for bins with fewer points."""


def plot_stage_bars(
    cases: Mapping[str, Mapping[str, float]],
    path: str | Path,
    title: str = '',
    baseline: tuple[str, float] | None = None,
    *,
    force: bool = False,
) -> None:
    """Draw one bar per case, in stages, as a PNG.

    Parameters
    ----------
    cases : mapping of str to mapping of str to float
        Time of each stage by its name [ms], by name of the case; at least one, all with the
        same stages.
    path : str or Path
        File to write.
    title : str
        Line above.
    baseline : tuple of str and float, optional
        Name of another method and its time for a whole frame [ms].
    force : bool
        Whether an existing file is replaced.
    """
    stages = list(next(iter(cases.values())))
    height = AROUND + BAR * len(cases)
    figure = new_figure(BARS_WIDTH, height)
    axes = figure.add_axes((0.19, 0.75 / height, 0.77, BAR * len(cases) / height))
    start = np.zeros(len(cases))
    for stage, colour in zip(stages, cycle(STAGE_COLOURS)):
        width = np.array([case[stage] for case in cases.values()])
        axes.barh(list(cases), width, left=start, color=colour, label=stage, height=0.72)
        start += width
    if baseline is not None:
        name, time = baseline
        axes.axvline(
            time, color=REFERENCE_COLOUR, linewidth=1.5, linestyle=(0, (4, 3)),
            label=f'{name}, whole frame',
        )  # fmt: skip
    axes.invert_yaxis()
    axes.set_xlabel('median time per frame [ms]')
    axes.spines[['top', 'right']].set_visible(False)
    axes.tick_params(axis='y', length=0)
    axes.set_xlim(left=0.0)
    figure.legend(
        loc='upper center', ncols=len(stages) + 1, frameon=False, fontsize=9.5,
        bbox_to_anchor=(0.5, 1.0 - 0.55 / height), handlelength=1.2, columnspacing=1.2,
    )  # fmt: skip
    figure.text(
        0.5, 1.0 - 0.3 / height, title, fontsize=11, ha='center', va='center', parse_math=False
    )
    save(figure, path, force=force)


class Reliability(Protocol):
    """Points by bin of probability, (B,) each, and scores of all: see `evaluation.calibration`."""

    @property
    def n_points(self) -> IntArray: ...  # noqa: D102
    @property
    def mean_p(self) -> FloatArray: ...  # noqa: D102
    @property
    def share_ground(self) -> FloatArray: ...  # noqa: D102
    @property
    def ece(self) -> float: ...  # noqa: D102
    @property
    def brier(self) -> float: ...  # noqa: D102


def plot_reliability(
    pooled: Reliability, sequences: Mapping[str, Reliability], path: str | Path, title: str = ''
) -> None:
    """Draw the share of ground over probability, and points per bin below, as a PNG.

    Parameters
    ----------
    pooled : Reliability
        Of all frames.
    sequences : mapping of str to Reliability
        By sequence; drawn thin if there is more than one.
    path : str or Path
        File to write, replaced if it exists.
    title : str
        Line above.

    Raises
    ------
    PointCloudError
        If there is no point to draw.
    """
    if not pooled.n_points.sum():
        raise PointCloudError('reliability diagram: no scored point has a probability')
    height = TITLE + SQUARE + GAP + COUNTS + BOTTOM
    width = LEFT + SQUARE + RIGHT
    figure = new_figure(width, height)
    left, across = LEFT / width, SQUARE / width
    upper = figure.add_axes((left, (BOTTOM + COUNTS + GAP) / height, across, SQUARE / height))
    lower = figure.add_axes((left, BOTTOM / height, across, COUNTS / height), sharex=upper)
    upper.tick_params(labelbottom=False)
    upper.plot([0, 1], [0, 1], color=REFERENCE_COLOUR, linestyle='--', linewidth=1, label='ideal')
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
    save(figure, path)


def _draw_line(axes: Any, one: Reliability, **style: Any) -> None:
    enough = one.n_points >= MIN_POINTS
    axes.plot(one.mean_p[enough], one.share_ground[enough], markersize=6, clip_on=False, **style)


def _draw_counts(axes: Any, pooled: Reliability) -> None:
    share = 100.0 * pooled.n_points / pooled.n_points.sum()
    edges = np.linspace(0.0, 1.0, len(share) + 1)
    axes.bar(
        edges[:-1], share, np.diff(edges), align='edge', color=COUNT_COLOUR, edgecolor='white'
    )
    axes.set_yscale('log')
    axes.set_ylim(min(0.1, 0.7 * share[share > 0].min()), 100.0)
    axes.set_yticks([0.1, 1.0, 10.0, 100.0], ['0.1', '1', '10', '100'])
    axes.minorticks_off()
    axes.set_ylabel('points [%]')
    axes.set_xlabel('probability of ground, p_ground')
