"""A search of parameters: the IoU of its trials."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.lab.plotting.style import VERMILION, new_figure, save

SIZE, N_COLUMNS = (4.4, 3.6), 3
"""Size of a panel [inch], and how many are in a row."""


def plot_search(trials: Sequence[Any], logarithmic: Collection[str], path: str | Path) -> None:
    """Draw IoU by trial, and over each parameter, as a PNG, replacing the file `path`.

    `trials` have a `choice` of values by name, and an `iou`; the axes of parameters whose names
    are in `logarithmic` are so.
    """
    iou = 100.0 * np.array([trial.iou for trial in trials])
    best, order = int(iou.argmax()), np.arange(len(iou))
    names = ['trial', *trials[0].choice]
    n_columns = min(len(names), N_COLUMNS)
    n_rows = -(-len(names) // n_columns)
    figure = new_figure(SIZE[0] * n_columns, SIZE[1] * n_rows)
    panels = figure.subplots(n_rows, n_columns, sharey=True, squeeze=False).ravel()
    for axes, name in zip(panels, names, strict=False):
        values = [k if name == 'trial' else one.choice[name] for k, one in enumerate(trials)]
        if isinstance(values[0], str | bool):
            values = [str(value).lower() for value in values]
        axes.scatter(values, iou, c=order, cmap='Blues', edgecolors='#6B7178', linewidths=0.4)
        axes.plot(values[best], iou[best], 'o', ms=9, mfc='none', mec=VERMILION, mew=2)
        if name in logarithmic:
            axes.set_xscale('log')
            axes.tick_params(axis='x', which='minor', labelbottom=False)
        axes.set(xlabel=name, ylabel='IoU on the frames searched [%]')
    panels[0].set_xlabel('trial (line: best so far; dark: late)')
    panels[0].plot(order, np.maximum.accumulate(iou), color=VERMILION)
    # Values that fail altogether would leave no room for the others.
    low, high = np.quantile(iou, 0.25), iou.max()
    margin = 0.1 * (high - low) + 0.01
    panels[0].set_ylim(low - margin, high + margin)
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    figure.tight_layout()
    save(figure, path)
