"""A segmented scan in perspective, its labels and their errors; and what all pictures share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import require
from gp_ground_seg.core.frame import BoolArray, FloatArray, Label
from gp_ground_seg.core.log import in_thousands
from gp_ground_seg.core.pipeline.points import check_points
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.colours import COLOURS
from gp_ground_seg.lab.scoring.metrics import Labels, check_lengths

DPI = 120

GREEN, VIOLET = '#009E73', '#7A4FA3'
"""Of Okabe and Ito's palette, and one that is told apart from it with any colour vision."""


def new_figure(width: float, height: float, dpi: int = DPI) -> Any:
    """Return an empty matplotlib figure [inch] outside pyplot's global state."""
    return require('matplotlib.figure', 'matplotlib').Figure((width, height), dpi=dpi)


def save(figure: Any, path: str | Path) -> None:
    """Write a figure as PDF or SVG where `path` ends so, else as PNG, replacing the file."""
    from matplotlib import rc_context

    kind = {'.pdf': 'pdf', '.svg': 'svg'}.get(Path(path).suffix.lower(), 'png')
    # With their dates, and names by chance, no two files would be equal.
    metadata = {'pdf': {'CreationDate': None}, 'svg': {'Date': None}}.get(kind, {})
    with staged_file(path, force=True) as part, rc_context({'svg.hashsalt': 'gp_ground_seg'}):
        figure.savefig(part, format=kind, metadata=metadata)


# Size of the scene, of the title above it and of the legend below it [inch].
WIDTH, HEIGHT, TITLE, FOOT = 12.0, 6.0, 0.4, 0.6
CLOSEST = 1.0
"""Nothing nearer to the camera than this is drawn [m]."""
# Places of the camera and of the middle of the picture, sensor frame [m].
CAMERA, TARGET = (-16.0, -7.0, 10.0), (12.0, 1.0, -3.0)
ZOOM = 0.75
"""Focal length over the width of the picture."""

Place = tuple[float, float, float]
Layers = dict[str, BoolArray]
"""Which points, (N,), are drawn in each of `COLOURS`."""
DEPTHS = {'ground': 1, 'obstacle': 2, 'missed ground': 3, 'false ground': 3}
"""Layers of points from below."""


def plot_scan_view(
    points: npt.ArrayLike,
    label: Labels,
    path: str | Path,
    title: str = '',
    camera: Place = CAMERA,
    *,
    truth: Labels | None = None,
) -> str:
    """Draw a scan in perspective, replacing the file `path`; return numbers of points.

    Ground and obstacles of `points`, (N, >=3) [m], by their `Label`; with the true labels, UNKNOWN
    where a point does not count, the errors too. `camera` is in the sensor frame [m]. In a PDF
    or SVG points are pixels.
    """
    xyz = check_points(points)
    check_lengths(len(xyz), label=label, truth=truth)
    said, layers = label_layers(label, truth)
    whole = FOOT + HEIGHT + (TITLE if title else 0.0)
    figure = new_figure(WIDTH, whole)
    figure.text(
        0.5, 1.0 - 0.5 * TITLE / whole, title,
        ha='center', va='center', parse_math=False, fontsize=14,
    )  # fmt: skip
    # matplotlib's own layouts leave no room for a legend below equal axes.
    axes = figure.add_axes((0.0, FOOT / whole, 1.0, HEIGHT / whole))
    _draw_points(axes, xyz, layers, camera)
    axes.set_axis_off()
    axes.set_aspect('equal')
    axes.set_xlim(-0.5, 0.5)
    axes.set_ylim(-0.5 * HEIGHT / WIDTH, 0.5 * HEIGHT / WIDTH)
    for name in layers:  # dots as small as in the picture would show no colour
        axes.plot([], [], 'o', markersize=7, color=COLOURS[name], label=name)
    figure.legend(loc='lower left', fontsize=11, frameon=False, ncols=4)
    save(figure, path)
    return said


def camera_at(azimuth: float, elevation: float, distance: float) -> Place:
    """Return where a camera stands that looks at the middle of the scene, sensor frame [m].

    The direction [degrees] and the distance [m] are seen from that middle.
    """
    turn, up = math.radians(azimuth), math.radians(elevation)
    across = math.cos(turn) * math.cos(up), math.sin(turn) * math.cos(up), math.sin(up)
    x, y, z = np.add(TARGET, np.multiply(distance, across)).tolist()
    return x, y, z


def project(points: FloatArray, camera: Place = CAMERA) -> tuple[FloatArray, FloatArray]:
    """Return places in the picture and depths [m] of points, (..., 2) and (...).

    A place is in widths of the picture, right and up of its middle; NaN nearer than `CLOSEST`.
    """
    forward = np.subtract(TARGET, camera)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (points - camera) @ np.stack([right, np.cross(right, forward), forward]).T
    depth: FloatArray = seen[..., 2]
    safe = np.where(depth > CLOSEST, depth, np.nan)
    place: FloatArray = ZOOM * seen[..., :2] / safe[..., None]
    return place, depth


def _draw_points(axes: Any, xyz: FloatArray, layers: Layers, camera: Place) -> None:
    """Draw far points first, and the ground below all obstacles."""
    place, depth = project(xyz, camera)
    for name, layer in layers.items():
        chosen = np.flatnonzero(layer & (depth > CLOSEST))
        chosen = chosen[np.argsort(-depth[chosen])]
        axes.scatter(
            *place[chosen].T, s=np.clip(60.0 / depth[chosen], 1.0, 5.0), linewidths=0.0,
            rasterized=True, c=COLOURS[name], zorder=DEPTHS[name],
        )  # fmt: skip


def label_layers(label: Labels, truth: Labels | None = None) -> tuple[str, Layers]:
    """Return numbers of points in words, and the layers of their labels (N,).

    With the true labels, UNKNOWN where a point does not count, those of the errors.
    """
    layers = {'ground': label == Label.GROUND, 'obstacle': label == Label.OBSTACLE}
    n_points, n_given, n_obstacle = len(label), *(int(part.sum()) for part in layers.values())
    if truth is None:
        words = f'{in_thousands(n_points)} points: {in_thousands(n_given)} ground'
        words += f', {in_thousands(n_obstacle)} obstacle'
        n_unknown = n_points - n_given - n_obstacle
        return f'{words}, {in_thousands(n_unknown)} unknown' if n_unknown else words, layers
    given, ground = layers['ground'], truth == Label.GROUND
    layers['missed ground'] = ground & ~given
    layers['false ground'] = given & (truth == Label.OBSTACLE)
    n_missed, n_false = (int(layers[name].sum()) for name in ('missed ground', 'false ground'))
    words = f'{in_thousands(n_false)} false ground, {in_thousands(n_missed)} missed ground'
    if n_union := int(ground.sum()) + n_false:
        words += f', IoU {100.0 * (1.0 - (n_missed + n_false) / n_union):.2f} %'
    return words, layers
