"""A segmented scan in perspective: its labels, errors or heights, and the ground model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import BoolArray, FloatArray, Label
from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.core.log import in_thousands
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.points import check_points
from gp_ground_seg.data.colours import COLOURS, HEIGHTS, length_scale_colours, ramp_colours
from gp_ground_seg.lab.plotting import style
from gp_ground_seg.lab.plotting.style import add_axes, new_figure, save, write_line
from gp_ground_seg.lab.scoring.metrics import Labels, check_lengths

VALUES = {
    'height': ('height over the ground [m]', *HEIGHTS),
    'p_ground': ('probability of ground', 0.0, 1.0),
}
"""Attributes of `Segmentation` that points can be coloured by: title and ends of the scale."""

# Size of the scene, of the title above it and of the legend below it [inch].
WIDTH, HEIGHT, TITLE, FOOT = 12.0, 6.0, 0.4, 0.6
N_STD, N_PROFILES = 2.0, 60
CLOSEST = 1.0
"""Nothing nearer to the camera than this is drawn [m]."""
# Places of the camera and of the middle of the picture, sensor frame [m].
CAMERA, TARGET = (-16.0, -7.0, 10.0), (12.0, 1.0, -3.0)
ZOOM = 0.75
"""Focal length over the width of the picture."""

Place = tuple[float, float, float]
Layers = dict[str, BoolArray]
"""Which points, (N,), are drawn in each of `COLOURS`."""
DEPTHS = {'ground': 1, 'obstacle': 4, 'missed ground': 5, 'false ground': 5}
"""Layers of points from below; those of the surface are between the first two."""


def plot_scan_view(
    points: npt.ArrayLike,
    label: Labels,
    path: str | Path,
    title: str = '',
    camera: Place = CAMERA,
    *,
    truth: Labels | None = None,
    values: tuple[str, FloatArray] | None = None,
    surface: tuple[GroundModel, Config] | None = None,
) -> str:
    """Draw a scan in perspective, replacing the file `path`; return numbers of points.

    Ground and obstacles of `points`, (N, >=3) [m], by their `Label`; with the true labels, UNKNOWN
    where a point does not count, the errors too. `values` colour the points instead: a name of
    `VALUES`, and (N,) of them. `surface` is drawn coloured by length-scale, with profiles of two
    standard deviations, where it is at least as certain as ``label.ground_tolerance``. `camera`
    is in the sensor frame [m]. In a PDF or SVG points are pixels.
    """
    xyz = check_points(points)
    check_lengths(len(xyz), label=label, truth=truth)
    said, layers = label_layers(label, truth)
    figure = new_figure(WIDTH, FOOT + HEIGHT + (TITLE if title else 0.0))
    write_line(figure, title, 0.5, 0.5 * TITLE, fontsize=14)
    axes = add_axes(figure, 0.0, FOOT, (WIDTH, HEIGHT))
    _draw_points(axes, xyz, layers, camera, values)
    if surface is not None:
        _draw_surface(axes, *surface, camera, is_plain=values is not None)
    axes.set_axis_off()
    axes.set_aspect('equal')
    axes.set_xlim(-0.5, 0.5)
    axes.set_ylim(-0.5 * HEIGHT / WIDTH, 0.5 * HEIGHT / WIDTH)
    _draw_legend(figure, layers, values, surface)
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


def _draw_points(
    axes: Any,
    xyz: FloatArray,
    layers: Layers,
    camera: Place,
    values: tuple[str, FloatArray] | None,
) -> None:
    """Draw far points first, and the ground below all obstacles."""
    place, depth = project(xyz, camera)
    for name, layer in layers.items():
        chosen = np.flatnonzero(layer & (depth > CLOSEST))
        chosen = chosen[np.argsort(-depth[chosen])]
        look: dict[str, Any] = {'c': COLOURS[name], 'zorder': DEPTHS[name]}
        if values is not None and name in ('ground', 'obstacle'):
            look = {'c': ramp_colours(values[1][chosen], *VALUES[values[0]][1:]), 'zorder': 4}
        axes.scatter(
            *place[chosen].T, s=np.clip(60.0 / depth[chosen], 1.0, 5.0), linewidths=0.0,
            rasterized=True, **look,
        )  # fmt: skip


def _draw_surface(
    axes: Any, model: GroundModel, config: Config, camera: Place, *, is_plain: bool
) -> None:
    """Draw the surface, its profiles and their bands; grey if `is_plain`."""
    from matplotlib.collections import LineCollection, PolyCollection

    middle, lower, upper = (
        project(model.knot_points(n_std), camera)[0] for n_std in (0.0, -N_STD, N_STD)
    )
    certain = model.std <= config.label.ground_tolerance
    shown = certain & np.isfinite(upper + lower + middle).all(axis=-1)
    piece = shown[:, :-1] & shown[:, 1:]
    limits = config.length_scale
    colours = length_scale_colours(model.length_scale, limits.min, limits.max)
    if is_plain:
        colours = np.full_like(colours, 0.6)

    def add(drawn: BoolArray, corners: Sequence[FloatArray], kind: Any, **look: Any) -> None:
        shapes = np.stack([corner[drawn] for corner in corners], axis=1)
        collection = kind(list(shapes), rasterized=True, **look)
        collection.set_color(colours[:, :-1][drawn])
        axes.add_collection(collection)

    along = [middle[:, :-1], middle[:, 1:]]
    aside = [np.roll(middle, -1, axis=0)[:, ends] for ends in (slice(1, None), slice(-1))]
    filled = piece & np.roll(piece, -1, axis=0)
    flat = {'alpha': 0.45, 'linewidths': 0.0, 'antialiaseds': False, 'zorder': 2}
    add(filled, [*along, *aside], PolyCollection, **flat)
    piece[np.arange(len(piece)) % -(-len(piece) // N_PROFILES) > 0] = False
    band = [lower[:, :-1], lower[:, 1:], upper[:, 1:], upper[:, :-1]]
    add(piece, band, PolyCollection, alpha=0.35, linewidths=0.0, zorder=2)
    add(piece, along, LineCollection, linewidths=1.3, zorder=3)


def _draw_legend(
    figure: Any,
    layers: Layers,
    values: tuple[str, FloatArray] | None,
    surface: tuple[GroundModel, Config] | None,
) -> None:
    """Draw the legend below the scene."""
    names = [*layers]
    if values is not None:
        title, low, high = VALUES[values[0]]
        colours = ramp_colours(np.linspace(low, high, 200), low, high)
        _draw_ramp(figure, f'{title}; mid-grey: no model', colours, (low, high))
        names = names[2:]
    dots = style.legend_dots({name: COLOURS[name] for name in names}, 7)
    figure.legend(handles=dots, loc='lower left', fontsize=11, frameon=False, ncols=4)
    if surface is not None and values is None:
        _, config = surface
        low, high = config.length_scale.min, config.length_scale.max
        colours = length_scale_colours(np.geomspace(low, high, 200), low, high)
        title = 'length-scale of the ground [m]; bands: ± 2 std'
        bar = _draw_ramp(figure, title, colours, (math.log10(low), math.log10(high)))
        ticks = [tick for tick in (0.1, 0.3, 1, 3, 10, 30, 100, 300) if low <= tick <= high]
        bar.set_xticks(np.log10(ticks), labels=[f'{tick:g}' for tick in ticks])


def _draw_ramp(figure: Any, title: str, colours: FloatArray, ends: tuple[float, float]) -> Any:
    """Draw colours, (n, 3), over an axis below the scene, and return it."""
    bar = add_axes(figure, 0.66 * WIDTH, 0.26, (0.3 * WIDTH, 0.14))
    bar.imshow(colours[None], extent=(*ends, 0.0, 1.0), aspect='auto')
    bar.set_yticks([])
    bar.set_title(title, fontsize=9.5, loc='left', pad=3.0)
    return bar


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
