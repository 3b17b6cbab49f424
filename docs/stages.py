"""Draw docs/performance.json, the record of `make bench-docs`, as docs/images/performance.png."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path

import numpy as np

from gp_ground_seg.lab.plotting import style
from gp_ground_seg.lab.plotting.style import add_axes, new_figure, save, write_line
from gp_ground_seg.lab.scoring.evaluate import TITLES

DOCS = Path(__file__).resolve().parent
STAGE_COLOURS = (
    style.BLUE, style.SKY, style.GREEN, style.ORANGE, style.VERMILION, '#CC79A7', '#B4BAC0',
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


def main() -> None:
    """Draw the record."""
    document = json.loads((DOCS / 'performance.json').read_text(encoding='utf-8'))
    # Without compiled code a frame takes so long that the others would be but slivers.
    cases = [case for case in document['cases'] if case['backend'] == 'numba']
    title = (
        f'{document["n_frames"]} frames of {document["data"]}, {document["environment"]["cpu"]}'
    )
    bars = {case['name']: case['stages_ms'] for case in cases}
    line = TITLES[document['baseline']], document['baseline_ms']['median']
    plot_stage_bars(bars, DOCS / 'images' / 'performance.png', title, line)


if __name__ == '__main__':
    main()
