"""Charts: time by stage, and a search of parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.plotting import style
from gp_ground_seg.plotting.style import add_axes, new_figure, save, write_line

STAGE_COLOURS = (
    style.BLUE, style.SKY, style.GREEN, style.ORANGE, style.VERMILION, style.PINK, '#B4BAC0',
    style.VIOLET,
)  # fmt: skip
REFERENCE_COLOUR = '#3B4046'

# Inches: the bar chart, a bar, and what is above and below all bars.
BARS_WIDTH, BAR, AROUND = 10.0, 0.55, 1.9


def plot_stage_bars(
    cases: Mapping[str, Mapping[str, float]],
    path: str | Path,
    title: str,
    baseline: tuple[str, float] | None = None,
) -> None:
    """Draw one bar per case, in stages, as a PNG, replacing the file `path`.

    `cases` are the times of each stage [ms], by name of the case; at least one, all with the same
    stages. `baseline` is another method, and its time for a whole frame [ms].
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
        axes.axvline(time, color=REFERENCE_COLOUR, linestyle='--', label=f'{name}, whole frame')
    axes.invert_yaxis()
    axes.set_xlabel('median time per frame [ms]')
    axes.spines[['top', 'right']].set_visible(False)
    figure.legend(
        loc='upper center', ncols=len(stages) + 1, frameon=False, fontsize=9.5,
        bbox_to_anchor=(0.5, 1.0 - 0.55 / height), handlelength=1.2, columnspacing=1.2,
    )  # fmt: skip
    write_line(figure, title, 0.5, 0.3, fontsize=11)
    save(figure, path)


def plot_search(trials: Sequence[Any], logarithmic: Collection[str], path: str | Path) -> None:
    """Draw IoU by trial, and over each parameter, as a PNG, replacing the file `path`.

    `trials` have a `choice` of values by name, and an `iou`; the axes of parameters whose names
    are in `logarithmic` are so.
    """
    iou = 100.0 * np.array([trial.iou for trial in trials])
    best = int(iou.argmax())
    values: dict[str, list[Any]] = {'trial': list(range(len(iou)))}
    values |= {name: [trial.choice[name] for trial in trials] for name in trials[0].choice}
    n_columns = min(len(values), 3)
    n_rows = -(-len(values) // n_columns)
    figure = new_figure(4.4 * n_columns, 3.6 * n_rows)
    panels = list(figure.subplots(n_rows, n_columns, sharey=True, squeeze=False).flat)
    for axes, (name, own) in zip(panels, values.items(), strict=False):
        if isinstance(own[0], str | bool):
            own = [str(value).lower() for value in own]
        axes.scatter(
            own, iou, s=18, c=values['trial'], cmap='Blues', edgecolors='#6B7178', linewidths=0.4
        )
        axes.plot(own[best], iou[best], 'o', ms=9, mfc='none', mec=style.VERMILION, mew=2)
        if name in logarithmic:
            axes.set_xscale('log')
        axes.set_xlabel(name)
        axes.grid(color='#E3E6E9', linewidth=0.8)
    panels[0].plot(values['trial'], np.maximum.accumulate(iou), color=style.VERMILION)
    panels[0].set_xlabel('trial (line: best so far; dark: late)')
    # Values that fail altogether would leave no room for the others.
    low, high = np.quantile(iou, 0.25), iou.max()
    panels[0].set_ylim(low - 0.1 * (high - low) - 0.01, high + 0.1 * (high - low) + 0.01)
    for axes in panels[::n_columns]:
        axes.set_ylabel('IoU on the frames searched [%]')
    for axes in panels[len(values) :]:
        axes.set_axis_off()
    figure.tight_layout()
    save(figure, path)
