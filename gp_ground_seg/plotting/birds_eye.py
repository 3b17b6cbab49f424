"""Segmented scans from above: one with its errors, or a sheet of the worst."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import BoolArray, Label
from gp_ground_seg.pipeline.points import check_points, finite_points
from gp_ground_seg.plotting import style
from gp_ground_seg.plotting.style import add_axes, check_lengths, new_figure, save, write_line

Labels = npt.NDArray[np.uint8]

COLOURS = {
    'ground': '#E3B968',
    'obstacle': '#1B4F72',
    'unknown': style.PINK,
    'not scored': '#E3E6E9',
    'right': '#BCC2C8',
    # On a sheet, where true ground and true obstacles differ in lightness.
    'right obstacle': '#757D86',
    'right ground': '#D3C5A6',
    'missed ground': style.BLUE,
    'false ground': style.VERMILION,
}
EXTENT = 50.0
"""Half the side of the square shown [m]."""
RING_STEP = 10.0

# Inches: the square of a panel, left, right, below and above it; the line above all panels.
SINGLE = (6.2, 0.8, 0.2, 0.95, 0.4, 0.4)
SHEET = (5.4, 0.55, 0.15, 0.35, 0.62, 0.5)
SHEET_LEGEND = 0.45
SHEET_COLUMNS = 3


class Layer(NamedTuple):
    """Points drawn alike: one of `COLOURS`, area of a dot [pt^2], which points, (N,) bool."""

    name: str
    size: float
    chosen: BoolArray


class SheetPanel(NamedTuple):
    """One scan of a sheet: lines above it, x and y of the points [m], labels as in `Label`.

    The true label is UNKNOWN where the point does not count.
    """

    title: str
    subtitle: str
    points: npt.NDArray[np.floating]
    label: Labels
    truth: Labels


def plot_birds_eye(
    points: npt.ArrayLike,
    label: Labels,
    path: str | Path,
    truth: Labels | None = None,
    title: str = '',
) -> None:
    """Draw a scan from above as a PNG, replacing the file `path`.

    Parameters
    ----------
    points : (N, >=3) float array
        x forward, y left, z up [m].
    label : (N,) uint8
        `Label` of each point.
    truth : (N,) uint8, optional
        True `Label` of each point, UNKNOWN where it does not count. With it a
        second panel shows the errors.

    Raises
    ------
    PointCloudError
        If the shapes do not fit together.
    """
    xyz = check_points(points)
    check_lengths(len(xyz), label=label, truth=truth)
    xy = np.where(finite_points(xyz)[:, None], xyz[:, :2], np.nan)
    panels = [_label_panel(label)]
    if truth is not None:
        panels.append(_error_panel(label, truth))
    square, left, right, bottom, top, title_height = SINGLE
    panel_width, height = left + square + right, bottom + square + top
    figure = new_figure(panel_width * len(panels), height + (title_height if title else 0.0))
    write_line(figure, title, 0.5, 0.6 * title_height, fontsize=15, fontweight='bold')
    for k, (panel_title, layers) in enumerate(panels):
        axes = add_axes(figure, k * panel_width + left, bottom, (square, square))
        axes.set_title(panel_title, fontsize=11)
        shown, sensor = _draw_panel(axes, xy, layers, sensor_size=8)
        axes.set_xlabel('y, to the left [m]')
        axes.set_ylabel('x, forward [m]')
        axes.legend(
            handles=[*_dots(shown, 7), sensor], loc='upper center', bbox_to_anchor=(0.5, -0.08),
            ncols=len(shown) + 1, frameon=False, fontsize=10.5, handletextpad=0.2,
            columnspacing=1.5,
        )  # fmt: skip
    save(figure, path)


def plot_error_sheet(panels: Sequence[SheetPanel], path: str | Path, title: str) -> None:
    """Draw the errors of at least one scan from above, three in a row, replacing `path`, a PNG.

    Raises `PointCloudError` if the lengths of a panel differ.
    """
    square, left, right, bottom, top, title_height = SHEET
    n_columns = min(SHEET_COLUMNS, len(panels))
    panel_width, panel_height = left + square + right, top + square + bottom
    width, head = n_columns * panel_width, title_height + SHEET_LEGEND
    height = head + math.ceil(len(panels) / n_columns) * panel_height
    figure = new_figure(width, height)
    write_line(
        figure, title, left / width, 0.55 * title_height, fontsize=15, fontweight='bold', ha='left'
    )
    for k, (panel_title, subtitle, points, label, truth) in enumerate(panels):
        check_lengths(len(points), label=label, truth=truth)
        row, column = divmod(k, n_columns)
        base = height - head - row * panel_height - top - square
        axes = add_axes(figure, column * panel_width + left, base, (square, square))
        layers = _error_layers(label, truth, ('right obstacle', 'right ground'), (0.8, 2.6))
        _draw_panel(axes, points[:, :2], layers, sensor_size=7)
        axes.tick_params(labelsize=8)
        for line, above, look in (
            (panel_title, 20, {'fontsize': 12, 'fontweight': 'bold'}),
            (subtitle, 6, {'fontsize': 9.5, 'color': '#3B4046'}),
        ):
            axes.annotate(
                line, (0.0, 1.0), (0, above), 'axes fraction', textcoords='offset points',
                parse_math=False, **look,
            )  # fmt: skip
    figure.legend(
        handles=_dots(layers[::-1], 8), loc='center left', frameon=False, fontsize=11,
        bbox_to_anchor=(left / width, 1.0 - (title_height + 0.4 * SHEET_LEGEND) / height),
        ncols=len(layers) if n_columns > 1 else 3, handletextpad=0.2, columnspacing=1.2,
        borderpad=0.0, borderaxespad=0.0,
    )  # fmt: skip
    save(figure, path)


def _label_panel(label: Labels) -> tuple[str, list[Layer]]:
    """Return title and layers of the given labels."""
    shown = (Label.GROUND, Label.OBSTACLE, Label.UNKNOWN)
    layers = [Layer(value.name.lower(), 1.0, label == value) for value in shown]
    counts = [
        f'{_thousands(int(layer.chosen.sum()))} {layer.name}'
        for layer in layers
        if layer.name != 'unknown' or layer.chosen.any()
    ]
    return f'{_thousands(len(label))} points: {", ".join(counts)}', layers


def _error_panel(label: Labels, truth: Labels) -> tuple[str, list[Layer]]:
    """Return title and layers of the errors."""
    layers = _error_layers(label, truth, ('right',), (1.0, 3.0))
    missed, false = (layer.chosen for layer in layers[-2:])
    hit = (label == Label.GROUND) & (truth == Label.GROUND)
    n_hit, n_missed, n_false = (int(part.sum()) for part in (hit, missed, false))
    n_union = n_hit + n_missed + n_false
    iou = f', IoU {100.0 * n_hit / n_union:.2f} %' if n_union else ''
    return f'{_thousands(n_false)} false ground, {_thousands(n_missed)} missed ground{iou}', layers


def _error_layers(
    label: Labels, truth: Labels, right: tuple[str, ...], sizes: tuple[float, float]
) -> list[Layer]:
    """Return layers, lowest first; each point is in one. Sizes are of right points and errors."""
    given, ground, obstacle = label == Label.GROUND, truth == Label.GROUND, truth == Label.OBSTACLE
    chosen = {
        'not scored': ~(ground | obstacle),
        'right': (ground & given) | (obstacle & ~given),
        'right obstacle': obstacle & ~given,
        'right ground': ground & given,
        'missed ground': ground & ~given,
        'false ground': obstacle & given,
    }
    errors = ('missed ground', 'false ground')
    names = ('not scored', *right, *errors)
    return [Layer(name, sizes[name in errors], chosen[name]) for name in names]


def _thousands(number: int) -> str:
    return f'{number:,}'.replace(',', ' ')


def _dots(layers: Sequence[Layer], size: float) -> list[Any]:
    return style.legend_dots({layer.name: COLOURS[layer.name] for layer in layers}, size)


def _draw_panel(
    axes: Any, xy: npt.NDArray[np.floating], layers: Sequence[Layer], sensor_size: float
) -> tuple[list[Layer], Any]:
    """Draw points, rings of equal range and the sensor, forward up and left to the left.

    Returns the layers that have a point in the picture, and the legend entry of the sensor.
    """
    inside = (np.abs(xy) <= EXTENT).all(axis=1)  # False where it is NaN.
    shown = []
    for depth, layer in enumerate(layers, start=1):
        x, y = xy[layer.chosen & inside].T
        if len(x):
            colour = COLOURS[layer.name]
            axes.scatter(y, x, s=layer.size, c=colour, linewidths=0.0, zorder=depth)
            shown.append(layer)
    _draw_rings(axes, len(layers) + 1)
    axes.set_aspect('equal')
    axes.set_xlim(EXTENT, -EXTENT)
    axes.set_ylim(-EXTENT, EXTENT)
    (sensor,) = axes.plot(
        0, 0, marker='^', color='white', markeredgecolor='black', linestyle='none',
        markersize=sensor_size, zorder=len(layers) + 2, label='sensor',
    )  # fmt: skip
    return shown, sensor


def _draw_rings(axes: Any, depth: int) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    for radius in np.arange(RING_STEP, EXTENT * math.sqrt(2.0), RING_STEP):
        axes.plot(
            radius * np.cos(angle), radius * np.sin(angle), color='#6B7178', linewidth=0.5,
            linestyle=(0, (4, 4)), zorder=depth,
        )  # fmt: skip
        if radius < EXTENT:
            axes.text(
                *(-radius * math.sqrt(0.5),) * 2, f'{radius:g} m', fontsize=8, color='#3B4046',
                ha='center', va='center', zorder=depth,
                bbox={'boxstyle': 'round,pad=0.15', 'facecolor': 'white', 'edgecolor': 'none',
                      'alpha': 0.8},
            )  # fmt: skip
