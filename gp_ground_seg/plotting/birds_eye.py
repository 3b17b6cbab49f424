"""A segmented scan from above."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import ConfigError, PointCloudError
from gp_ground_seg.evaluation.metrics import count_confusion
from gp_ground_seg.frame import Label
from gp_ground_seg.pipeline.points import check_points, finite_points
from gp_ground_seg.plotting.canvas import new_figure

# After Okabe and Ito's palette, told apart with any colour vision and in grey print.
GROUND_COLOUR = '#E3B968'
OBSTACLE_COLOUR = '#1B4F72'
UNKNOWN_COLOUR = '#CC79A7'
RIGHT_COLOUR = '#BCC2C8'
LEFT_OUT_COLOUR = '#E3E6E9'
FALSE_GROUND_COLOUR = '#D55E00'
MISSED_GROUND_COLOUR = '#0072B2'

# Inches: the square of a panel, what is around it, and the line above all panels.
SQUARE, LEFT, RIGHT, BOTTOM, TOP, TITLE = 6.2, 0.8, 0.2, 0.95, 0.4, 0.4


@dataclass(frozen=True)
class _Layer:
    """Points drawn alike."""

    title: str
    colour: str
    size: float
    chosen: npt.NDArray[np.bool_]


def plot_birds_eye(
    points: npt.ArrayLike,
    label: npt.NDArray[np.uint8],
    path: str | Path,
    truth: npt.NDArray[np.uint8] | None = None,
    title: str = '',
    extent: float = 50.0,
) -> None:
    """Draw a scan from above as a PNG, replacing the file `path`.

    Parameters
    ----------
    points : (N, >=3) float array
        x forward, y left, z up [m].
    label : (N,) uint8
        `Label` of each point.
    path : str or Path
        File to write.
    truth : (N,) uint8, optional
        True `Label` of each point, UNKNOWN where it does not count. With it a
        second panel shows the errors.
    title : str
        Line above the panels.
    extent : float
        Half the side of the square shown [m].

    Raises
    ------
    PointCloudError
        If the shapes do not fit together.
    ConfigError
        If `extent` is not a positive number.
    MissingDependencyError
        If matplotlib is not installed.
    DataError
        If the file cannot be written.
    """
    xyz = check_points(points)
    finite = finite_points(xyz)
    for name, values in (('label', label), ('truth', truth)):
        if values is not None and values.shape != (len(xyz),):
            raise PointCloudError(
                f'{name} of shape {values.shape} for {len(xyz)} points: must be ({len(xyz)},)'
            )
    if not (extent > 0.0 and math.isfinite(extent)):
        raise ConfigError(f'extent = {extent}: must be a positive number of metres')
    shown = finite & (np.abs(xyz[:, :2]) <= extent).all(axis=1)
    panels = [(_label_title(label), _label_layers(label))]
    if truth is not None:
        panels.append((_error_title(label, truth), _error_layers(label, truth)))
    # Placed by hand: matplotlib's own layouts leave no room for a legend below equal axes.
    width = (LEFT + SQUARE + RIGHT) * len(panels)
    height = BOTTOM + SQUARE + TOP + (TITLE if title else 0.0)
    figure, canvas = new_figure(width, height)
    if title:
        figure.text(
            0.5, 1.0 - 0.6 * TITLE / height, title, fontsize=15, fontweight='bold',
            ha='center', va='center', parse_math=False,
        )  # fmt: skip
    for k, (panel_title, layers) in enumerate(panels):
        left = LEFT + k * (LEFT + SQUARE + RIGHT)
        axes = figure.add_axes((left / width, BOTTOM / height, SQUARE / width, SQUARE / height))
        axes.set_title(panel_title, fontsize=11)
        _draw_panel(axes, xyz, shown, layers, extent)
    with staged_file(path, force=True) as part:
        canvas.print_png(str(part))


def _label_layers(label: npt.NDArray[np.uint8]) -> list[_Layer]:
    return [
        _Layer('ground', GROUND_COLOUR, 1.0, label == Label.GROUND),
        _Layer('obstacle', OBSTACLE_COLOUR, 1.0, label == Label.OBSTACLE),
        _Layer('unknown', UNKNOWN_COLOUR, 1.0, label == Label.UNKNOWN),
    ]


def _label_title(label: npt.NDArray[np.uint8]) -> str:
    counts = [
        f'{_thousands(int(np.count_nonzero(label == value)))} {value.name.lower()}'
        for value in (Label.GROUND, Label.OBSTACLE, Label.UNKNOWN)
        if value is not Label.UNKNOWN or (label == value).any()
    ]
    return f'{_thousands(len(label))} points: {", ".join(counts)}'


def _error_layers(label: npt.NDArray[np.uint8], truth: npt.NDArray[np.uint8]) -> list[_Layer]:
    given = label == Label.GROUND
    false_ground = given & (truth == Label.OBSTACLE)
    missed_ground = ~given & (truth == Label.GROUND)
    left_out = truth == Label.UNKNOWN
    right = ~(false_ground | missed_ground | left_out)
    return [
        _Layer('not scored', LEFT_OUT_COLOUR, 1.0, left_out),
        _Layer('right', RIGHT_COLOUR, 1.0, right),
        _Layer('missed ground', MISSED_GROUND_COLOUR, 3.0, missed_ground),
        _Layer('false ground', FALSE_GROUND_COLOUR, 3.0, false_ground),
    ]


def _error_title(label: npt.NDArray[np.uint8], truth: npt.NDArray[np.uint8]) -> str:
    confusion = count_confusion(label, truth)
    iou = '' if math.isnan(confusion.iou) else f', IoU {100.0 * confusion.iou:.2f} %'
    return (
        f'{_thousands(confusion.fp)} false ground, {_thousands(confusion.fn)} missed ground{iou}'
    )


def _thousands(number: int) -> str:
    return f'{number:,}'.replace(',', ' ')


def _draw_panel(
    axes: Any,
    xyz: npt.NDArray[np.float64],
    shown: npt.NDArray[np.bool_],
    layers: list[_Layer],
    extent: float,
) -> None:
    """Forward is up and left is left, as a driver sees it."""
    from matplotlib.lines import Line2D

    legend = []
    for depth, layer in enumerate(layers):
        x, y = xyz[layer.chosen & shown, :2].T
        if len(x):
            axes.scatter(y, x, s=layer.size, c=layer.colour, linewidths=0.0, zorder=depth + 1)
            # A dot of its own: one as small as in the picture shows no colour.
            dot = Line2D([], [], marker='o', markersize=7, color=layer.colour, linestyle='none')
            dot.set_label(layer.title)
            legend.append(dot)
    draw_rings(axes, extent, len(layers) + 1)
    sensor = {'marker': '^', 'color': 'white', 'markeredgecolor': 'black', 'linestyle': 'none'}
    legend += axes.plot(0, 0, label='sensor', markersize=8, zorder=len(layers) + 2, **sensor)
    axes.set_aspect('equal')
    axes.set_xlim(extent, -extent)
    axes.set_ylim(-extent, extent)
    axes.set_xlabel('y, to the left [m]')
    axes.set_ylabel('x, forward [m]')
    axes.legend(
        handles=legend, loc='upper center', bbox_to_anchor=(0.5, -0.08), ncols=len(legend),
        frameon=False, fontsize=10.5, handletextpad=0.2, columnspacing=1.5,
    )  # fmt: skip


def draw_rings(axes: Any, extent: float, depth: int) -> None:
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
