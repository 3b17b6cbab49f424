"""A sheet of scans from above with their errors, so that the next step is visible."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.frame import Label
from gp_ground_seg.plotting.birds_eye import draw_rings
from gp_ground_seg.plotting.canvas import new_figure

# Errors after Okabe and Ito's palette (vermilion and blue: apart with any colour vision), what is
# right in sand and grey of clearly different lightness.
COLOURS = {
    'not scored': '#E2E5EA',
    'right obstacle': '#757D86',
    'right ground': '#D3C5A6',
    'missed ground': '#0072B2',
    'false ground': '#D55E00',
}
"""From the lowest layer to the highest."""
ERRORS = ('missed ground', 'false ground')
POINT_SIZE, ERROR_SIZE = 0.8, 2.6
"""Areas of the dots [pt^2]."""

N_COLUMNS = 3
# Inches: the square of a panel, what is around it, and the line above all panels.
SQUARE, LEFT, RIGHT, BOTTOM, TOP = 5.4, 0.55, 0.15, 0.35, 0.62
TITLE, LEGEND = 0.5, 0.45


@dataclass(frozen=True)
class SheetPanel:
    """One scan of the sheet.

    Attributes
    ----------
    title, subtitle : str
        Lines above it.
    points : (N, >=2) float
        x forward, y left [m].
    label, truth : (N,) uint8
        Given and true `Label`; truth is UNKNOWN where the point does not count.

    Raises
    ------
    PointCloudError
        If the lengths differ.
    """

    title: str
    subtitle: str
    points: npt.NDArray[np.floating]
    label: npt.NDArray[np.uint8]
    truth: npt.NDArray[np.uint8]

    def __post_init__(self) -> None:
        """Check that the arrays belong together."""
        n_points = len(self.points)
        for name in ('label', 'truth'):
            shape = getattr(self, name).shape
            if shape != (n_points,):
                raise PointCloudError(
                    f'{name} of shape {shape} for {n_points} points: must be ({n_points},)'
                )

    def layers(self) -> dict[str, npt.NDArray[np.bool_]]:
        """Points of each layer of `COLOURS`, (N,) bool; each point is in one."""
        given = self.label == Label.GROUND
        ground, obstacle = self.truth == Label.GROUND, self.truth == Label.OBSTACLE
        return {
            'not scored': ~(ground | obstacle),
            'right obstacle': obstacle & ~given,
            'right ground': ground & given,
            'missed ground': ground & ~given,
            'false ground': obstacle & given,
        }


def plot_error_sheet(
    panels: Sequence[SheetPanel], path: str | Path, title: str = '', extent: float = 50.0
) -> None:
    """Draw scans from above, three in a row, as a PNG that replaces the file `path`.

    Parameters
    ----------
    panels : sequence of SheetPanel
        At least one.
    path : str or Path
        File to write.
    title : str
        Line above all of them.
    extent : float
        Half the side of the square shown of each [m].

    Raises
    ------
    MissingDependencyError
        If matplotlib is not installed.
    DataError
        If the file cannot be written.
    """
    n_columns = min(N_COLUMNS, len(panels))
    n_rows = math.ceil(len(panels) / n_columns)
    panel_width, panel_height = LEFT + SQUARE + RIGHT, TOP + SQUARE + BOTTOM
    width = n_columns * panel_width
    height = TITLE + LEGEND + n_rows * panel_height
    figure, canvas = new_figure(width, height)
    figure.text(
        LEFT / width, 1.0 - 0.55 * TITLE / height, title, fontsize=15, fontweight='bold',
        ha='left', va='center', parse_math=False,
    )  # fmt: skip
    _draw_legend(figure, n_columns, 1.0 - (TITLE + 0.4 * LEGEND) / height, LEFT / width)
    for k, panel in enumerate(panels):
        row, column = divmod(k, n_columns)
        left = column * panel_width + LEFT
        bottom = height - TITLE - LEGEND - row * panel_height - TOP - SQUARE
        axes = figure.add_axes((left / width, bottom / height, SQUARE / width, SQUARE / height))
        _draw_panel(axes, panel, extent)
    with staged_file(path, force=True) as part:
        canvas.print_png(str(part))


def _draw_legend(figure: Any, n_columns: int, y: float, x: float) -> None:
    from matplotlib.lines import Line2D

    dots = [
        Line2D([], [], marker='o', markersize=8, color=COLOURS[name], linestyle='none', label=name)
        for name in reversed(COLOURS)
    ]
    figure.legend(
        handles=dots, loc='center left', bbox_to_anchor=(x, y), frameon=False, fontsize=11,
        ncols=len(dots) if n_columns > 1 else 3, handletextpad=0.2, columnspacing=1.2,
        borderpad=0.0, borderaxespad=0.0,
    )  # fmt: skip


def _draw_panel(axes: Any, panel: SheetPanel, extent: float) -> None:
    """Forward is up and left is left, as a driver sees it."""
    xy = panel.points[:, :2]
    shown = (np.abs(xy) <= extent).all(axis=1)  # not where it is NaN
    for depth, (name, chosen) in enumerate(panel.layers().items(), start=1):
        x, y = xy[chosen & shown].T
        size = ERROR_SIZE if name in ERRORS else POINT_SIZE
        axes.scatter(y, x, s=size, c=COLOURS[name], linewidths=0.0, zorder=depth)
    draw_rings(axes, extent, len(COLOURS) + 1)
    axes.plot(
        0, 0, marker='^', color='white', markeredgecolor='black', markersize=7,
        zorder=len(COLOURS) + 2,
    )  # fmt: skip
    axes.set_aspect('equal')
    axes.set_xlim(extent, -extent)
    axes.set_ylim(-extent, extent)
    axes.tick_params(labelsize=8)
    axes.annotate(
        panel.title, (0.0, 1.0), (0, 20), 'axes fraction', textcoords='offset points',
        fontsize=12, fontweight='bold', parse_math=False,
    )  # fmt: skip
    axes.annotate(
        panel.subtitle, (0.0, 1.0), (0, 6), 'axes fraction', textcoords='offset points',
        fontsize=9.5, color='#3B4046', parse_math=False,
    )  # fmt: skip
