"""Segmented scans from above: one with its errors, or a sheet of the worst."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.frame import BoolArray, Label
from gp_ground_seg.pipeline.points import check_points, finite_points
from gp_ground_seg.plotting.style import BLUE, PINK, VERMILION, check_lengths, new_figure, save

GROUND_COLOUR = '#E3B968'
OBSTACLE_COLOUR = '#1B4F72'
UNKNOWN_COLOUR = PINK
RIGHT_COLOUR = '#BCC2C8'
NOT_SCORED_COLOUR = '#E3E6E9'
FALSE_GROUND_COLOUR = VERMILION
MISSED_GROUND_COLOUR = BLUE
# On a sheet, where true ground and true obstacles differ in lightness.
RIGHT_OBSTACLE_COLOUR = '#757D86'
RIGHT_GROUND_COLOUR = '#D3C5A6'

# Inches: the square of a panel, left, right, below and above it; the line above all panels.
SINGLE = (6.2, 0.8, 0.2, 0.95, 0.4, 0.4)
SHEET = (5.4, 0.55, 0.15, 0.35, 0.62, 0.5)
SHEET_LEGEND = 0.45
SHEET_COLUMNS = 3


class Layer(NamedTuple):
    """Points drawn alike: name in the legend, area of a dot [pt^2], which points, (N,) bool."""

    name: str
    colour: str
    size: float
    chosen: BoolArray


def plot_birds_eye(
    points: npt.ArrayLike,
    label: npt.NDArray[np.uint8],
    path: str | Path,
    truth: npt.NDArray[np.uint8] | None = None,
    title: str = '',
    extent: float = 50.0,
) -> None:
    """Draw a scan from above, replacing the file `path`.

    Parameters
    ----------
    points : (N, >=3) float array
        x forward, y left, z up [m].
    label : (N,) uint8
        `Label` of each point.
    path : str or Path
        File to write, a PNG.
    truth : (N,) uint8, optional
        True `Label` of each point, UNKNOWN where it does not count. With it a
        second panel shows the errors.
    title : str
        Line above the panels.
    extent : float
        Half the side of the square shown [m].

    Raises
    ------
    PointCloudError, ConfigError
        If the shapes do not fit together; if `extent` is not a positive number.
    """
    xyz = check_points(points)
    check_lengths(len(xyz), label=label, truth=truth)
    if not (extent > 0.0 and math.isfinite(extent)):
        raise ConfigError(f'extent = {extent}: must be a positive number of metres')
    xy = np.where(finite_points(xyz)[:, None], xyz[:, :2], np.nan)
    panels = [_label_panel(label)]
    if truth is not None:
        panels.append(_error_panel(label, truth))
    # Placed by hand: matplotlib's own layouts leave no room for a legend below equal axes.
    square, left, right, bottom, top, title_height = SINGLE
    width = (left + square + right) * len(panels)
    height = bottom + square + top + (title_height if title else 0.0)
    figure = new_figure(width, height)
    if title:
        figure.text(
            0.5, 1.0 - 0.6 * title_height / height, title, fontsize=15, fontweight='bold',
            ha='center', va='center', parse_math=False,
        )  # fmt: skip
    for k, (panel_title, layers) in enumerate(panels):
        start = left + k * (left + square + right)
        axes = figure.add_axes((start / width, bottom / height, square / width, square / height))
        axes.set_title(panel_title, fontsize=11)
        shown = _draw_layers(axes, xy, layers, extent)
        sensor = _draw_sensor(axes, len(layers) + 2, size=8)
        axes.set_xlabel('y, to the left [m]')
        axes.set_ylabel('x, forward [m]')
        axes.legend(
            handles=[*_dots(shown, 7), sensor], loc='upper center', bbox_to_anchor=(0.5, -0.08),
            ncols=len(shown) + 1, frameon=False, fontsize=10.5, handletextpad=0.2,
            columnspacing=1.5,
        )  # fmt: skip
    save(figure, path)


class SheetPanel(NamedTuple):
    """One scan of a sheet.

    Attributes
    ----------
    title, subtitle : str
        Lines above it.
    points : (N, >=2) float
        x forward, y left [m].
    label, truth : (N,) uint8
        Given and true `Label`; truth is UNKNOWN where the point does not count.
    """

    title: str
    subtitle: str
    points: npt.NDArray[np.floating]
    label: npt.NDArray[np.uint8]
    truth: npt.NDArray[np.uint8]

    def layers(self) -> list[Layer]:
        """Return the layers, lowest first; each point is in one."""
        given = self.label == Label.GROUND
        ground, obstacle = self.truth == Label.GROUND, self.truth == Label.OBSTACLE
        return [
            Layer('not scored', NOT_SCORED_COLOUR, 0.8, ~(ground | obstacle)),
            Layer('right obstacle', RIGHT_OBSTACLE_COLOUR, 0.8, obstacle & ~given),
            Layer('right ground', RIGHT_GROUND_COLOUR, 0.8, ground & given),
            Layer('missed ground', MISSED_GROUND_COLOUR, 2.6, ground & ~given),
            Layer('false ground', FALSE_GROUND_COLOUR, 2.6, obstacle & given),
        ]


def plot_error_sheet(
    panels: Sequence[SheetPanel], path: str | Path, title: str = '', extent: float = 50.0
) -> None:
    """Draw the errors of scans from above, three in a row, replacing the file `path`.

    Parameters
    ----------
    panels : sequence of SheetPanel
        At least one.
    path : str or Path
        File to write, a PNG.
    title : str
        Line above all of them.
    extent : float
        Half the side of the square shown of each [m].

    Raises
    ------
    PointCloudError
        If the lengths of a panel differ.
    """
    for panel in panels:
        check_lengths(len(panel.points), label=panel.label, truth=panel.truth)
    square, left, right, bottom, top, title_height = SHEET
    n_columns = min(SHEET_COLUMNS, len(panels))
    panel_width, panel_height = left + square + right, top + square + bottom
    width = n_columns * panel_width
    height = title_height + SHEET_LEGEND + math.ceil(len(panels) / n_columns) * panel_height
    figure = new_figure(width, height)
    figure.text(
        left / width, 1.0 - 0.55 * title_height / height, title, fontsize=15, fontweight='bold',
        ha='left', va='center', parse_math=False,
    )  # fmt: skip
    dots = _dots(panels[0].layers()[::-1], 8)
    figure.legend(
        handles=dots, loc='center left', frameon=False, fontsize=11,
        bbox_to_anchor=(left / width, 1.0 - (title_height + 0.4 * SHEET_LEGEND) / height),
        ncols=len(dots) if n_columns > 1 else 3, handletextpad=0.2, columnspacing=1.2,
        borderpad=0.0, borderaxespad=0.0,
    )  # fmt: skip
    for k, panel in enumerate(panels):
        row, column = divmod(k, n_columns)
        start = column * panel_width + left
        base = height - title_height - SHEET_LEGEND - row * panel_height - top - square
        axes = figure.add_axes((start / width, base / height, square / width, square / height))
        layers = panel.layers()
        _draw_layers(axes, panel.points[:, :2], layers, extent)
        _draw_sensor(axes, len(layers) + 2, size=7)
        axes.tick_params(labelsize=8)
        for line, above, style in (
            (panel.title, 20, {'fontsize': 12, 'fontweight': 'bold'}),
            (panel.subtitle, 6, {'fontsize': 9.5, 'color': '#3B4046'}),
        ):
            axes.annotate(
                line, (0.0, 1.0), (0, above), 'axes fraction', textcoords='offset points',
                parse_math=False, **style,
            )  # fmt: skip
    save(figure, path)


def _label_panel(label: npt.NDArray[np.uint8]) -> tuple[str, list[Layer]]:
    """Return title and layers of the given labels."""
    layers = [
        Layer('ground', GROUND_COLOUR, 1.0, label == Label.GROUND),
        Layer('obstacle', OBSTACLE_COLOUR, 1.0, label == Label.OBSTACLE),
        Layer('unknown', UNKNOWN_COLOUR, 1.0, label == Label.UNKNOWN),
    ]
    counts = [
        f'{_thousands(int(layer.chosen.sum()))} {layer.name}'
        for layer in layers
        if layer.name != 'unknown' or layer.chosen.any()
    ]
    return f'{_thousands(len(label))} points: {", ".join(counts)}', layers


def _error_panel(
    label: npt.NDArray[np.uint8], truth: npt.NDArray[np.uint8]
) -> tuple[str, list[Layer]]:
    """Return title and layers of the errors."""
    given, ground = label == Label.GROUND, truth == Label.GROUND
    false, missed = given & (truth == Label.OBSTACLE), ~given & ground
    not_scored = truth == Label.UNKNOWN
    layers = [
        Layer('not scored', NOT_SCORED_COLOUR, 1.0, not_scored),
        Layer('right', RIGHT_COLOUR, 1.0, ~(false | missed | not_scored)),
        Layer('missed ground', MISSED_GROUND_COLOUR, 3.0, missed),
        Layer('false ground', FALSE_GROUND_COLOUR, 3.0, false),
    ]
    n_hit, n_false, n_missed = (int(part.sum()) for part in (given & ground, false, missed))
    n_union = n_hit + n_false + n_missed
    iou = f', IoU {100.0 * n_hit / n_union:.2f} %' if n_union else ''
    return f'{_thousands(n_false)} false ground, {_thousands(n_missed)} missed ground{iou}', layers


def _thousands(number: int) -> str:
    return f'{number:,}'.replace(',', ' ')


def _draw_layers(
    axes: Any, xy: npt.NDArray[np.floating], layers: Sequence[Layer], extent: float
) -> list[Layer]:
    """Draw the points and rings of equal range, forward up and left to the left.

    Returns the layers that have a point in the picture.
    """
    inside = (np.abs(xy) <= extent).all(axis=1)  # False where it is NaN.
    shown = []
    for depth, layer in enumerate(layers, start=1):
        x, y = xy[layer.chosen & inside].T
        if len(x):
            axes.scatter(y, x, s=layer.size, c=layer.colour, linewidths=0.0, zorder=depth)
            shown.append(layer)
    _draw_rings(axes, extent, len(layers) + 1)
    axes.set_aspect('equal')
    axes.set_xlim(extent, -extent)
    axes.set_ylim(-extent, extent)
    return shown


def _dots(layers: Sequence[Layer], size: float) -> list[Any]:
    """Return legend entries; dots as small as in the picture would show no colour."""
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], marker='o', markersize=size, color=colour, linestyle='none', label=name)
        for name, colour, *_ in layers
    ]


def _draw_sensor(axes: Any, depth: int, size: float) -> Any:
    (sensor,) = axes.plot(
        0, 0, marker='^', color='white', markeredgecolor='black', linestyle='none',
        markersize=size, zorder=depth, label='sensor',
    )  # fmt: skip
    return sensor


def _draw_rings(axes: Any, extent: float, depth: int) -> None:
    """Draw circles of equal range, at most five, a round number of metres apart."""
    step = _round_step(extent / 5.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    for radius in np.arange(step, extent * math.sqrt(2.0), step):
        axes.plot(
            radius * np.cos(angle), radius * np.sin(angle), color='#6B7178', linewidth=0.5,
            linestyle=(0, (4, 4)), zorder=depth,
        )  # fmt: skip
        if radius < extent:
            axes.text(
                -radius * math.sin(math.pi / 4), -radius * math.cos(math.pi / 4), f'{radius:g} m',
                fontsize=8, color='#3B4046', ha='center', va='center', zorder=depth,
                bbox={'boxstyle': 'round,pad=0.15', 'facecolor': 'white', 'edgecolor': 'none',
                      'alpha': 0.8},
            )  # fmt: skip


def _round_step(least: float) -> float:
    """Smallest of 1, 2, 5 times a power of ten that is at least `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least)
