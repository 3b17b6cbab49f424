"""Charts: time by stage, and how reliable the probability of ground is."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.frame import FloatArray, IntArray
from gp_ground_seg.plotting import style
from gp_ground_seg.plotting.style import add_axes, new_figure, save, write_line

STAGE_COLOURS = (
    style.BLUE, style.SKY, style.GREEN, style.ORANGE, style.VERMILION, style.PINK, '#B4BAC0',
    style.VIOLET,
)  # fmt: skip
REFERENCE_COLOUR = '#3B4046'
POOLED_COLOUR = style.BLUE
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
    title: str,
    baseline: tuple[str, float] | None = None,
    *,
    force: bool = False,
) -> None:
    """Draw one bar per case, in stages, as a PNG; `force` replaces an existing file.

    Parameters
    ----------
    cases : mapping of str to mapping of str to float
        Time of each stage by its name [ms], by name of the case; at least one, all with the
        same stages.
    baseline : tuple of str and float, optional
        Name of another method and its time for a whole frame [ms].
    """
    stages = list(next(iter(cases.values())))
    height = AROUND + BAR * len(cases)
    figure = new_figure(BARS_WIDTH, height)
    axes = add_axes(figure, 0.19 * BARS_WIDTH, 0.75, (0.77 * BARS_WIDTH, BAR * len(cases)))
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
    write_line(figure, title, 0.5, 0.3, fontsize=11)
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
    pooled: Reliability, sequences: Mapping[str, Reliability], path: str | Path, title: str
) -> None:
    """Draw the share of ground over probability, and points per bin below, as a PNG.

    `pooled` is of all frames; `sequences`, by name, are drawn thin if there is more than one.
    The file `path` is replaced. Raises `PointCloudError` if there is no point to draw.
    """
    if not pooled.n_points.sum():
        raise PointCloudError('reliability diagram: no scored point has a probability')
    height = TITLE + SQUARE + GAP + COUNTS + BOTTOM
    figure = new_figure(LEFT + SQUARE + RIGHT, height)
    upper = add_axes(figure, LEFT, BOTTOM + COUNTS + GAP, (SQUARE, SQUARE))
    lower = add_axes(figure, LEFT, BOTTOM, (SQUARE, COUNTS))
    lower.sharex(upper)
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
    share = 100.0 * pooled.n_points / pooled.n_points.sum()
    edges = np.linspace(0.0, 1.0, len(share) + 1)
    lower.bar(
        edges[:-1], share, np.diff(edges), align='edge', color=COUNT_COLOUR, edgecolor='white'
    )
    lower.set_yscale('log')
    lower.set_ylim(min(0.1, 0.7 * share[share > 0].min()), 100.0)
    lower.set_yticks([0.1, 1.0, 10.0, 100.0], ['0.1', '1', '10', '100'])
    lower.minorticks_off()
    lower.set_ylabel('points [%]')
    lower.set_xlabel('probability of ground, p_ground')
    save(figure, path)


def _draw_line(axes: Any, one: Reliability, **look: Any) -> None:
    enough = one.n_points >= MIN_POINTS
    axes.plot(one.mean_p[enough], one.share_ground[enough], markersize=6, clip_on=False, **look)
