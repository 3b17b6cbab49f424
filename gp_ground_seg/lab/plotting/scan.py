"""A segmented scan: in perspective with the ground model on it, or from above with its errors."""

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
from gp_ground_seg.core.pipeline.points import check_points, finite_points
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.colours import COLOURS, HEIGHTS, length_scale_colours, ramp_colours
from gp_ground_seg.lab.plotting import style
from gp_ground_seg.lab.plotting.style import add_axes, new_figure, save, write_line
from gp_ground_seg.lab.scoring.metrics import Labels

VALUES = {
    'height': ('height over the ground [m]', *HEIGHTS),
    'p_ground': ('probability of ground', 0.0, 1.0),
}
"""Attributes of `Segmentation` that points can be coloured by: title and ends of the scale."""

# In perspective. Size of the scene, of the title above it and of the legend below it [inch].
WIDTH, HEIGHT, TITLE, FOOT = 12.0, 6.0, 0.4, 0.6
N_STD, N_PROFILES = 2.0, 60
CLOSEST = 1.0
"""Nothing nearer to the camera than this is drawn [m]."""
# Places of the camera and of the middle of the picture, sensor frame [m].
CAMERA, TARGET = (-16.0, -7.0, 10.0), (12.0, 1.0, -3.0)
ZOOM = 0.75
"""Focal length over the width of the picture."""

# From above.
EXTENT, RING_STEP = 50.0, 10.0
"""Half the side of the square that is shown, and the step between the rings in it [m]."""
# Inches: the square of a panel, left, right, below and above it; the line above all panels.
SQUARE, LEFT, RIGHT, BELOW, ABOVE, LINE = 6.2, 0.8, 0.2, 0.95, 0.4, 0.4

Place = tuple[float, float, float]
Layers = dict[str, BoolArray]
"""Which points, (N,), are drawn in each of `COLOURS`, lowest first."""


def plot_scan_view(
    points: npt.ArrayLike,
    segmentation: Segmentation,
    config: Config,
    path: str | Path,
    title: str = '',
    camera: Place = CAMERA,
    colour: str = 'class',
    *,
    surface: bool = False,
) -> str:
    """Draw a scan in perspective, replacing the file `path`; return numbers of points.

    Ground and obstacles of `points`, (N, >=3) [m]; with `surface` the ground model too, coloured
    by length-scale, with profiles of two standard deviations, where it is at least as certain as
    ``label.ground_tolerance``. In a PDF or SVG points are pixels. `camera` is in the sensor frame
    [m]; `colour` is ``class`` or of `VALUES`.
    """
    xyz = check_points(points)
    style.check_lengths(len(xyz), label=segmentation.label)
    figure = new_figure(WIDTH, FOOT + HEIGHT + (TITLE if title else 0.0))
    write_line(figure, title, 0.5, 0.5 * TITLE, fontsize=14)
    axes = add_axes(figure, 0.0, FOOT, (WIDTH, HEIGHT))
    _draw_points(axes, xyz, segmentation, camera, colour)
    if surface:
        model = GroundModel.of(segmentation)
        _draw_surface(axes, model, config, camera, is_plain=colour in VALUES)
    axes.set_axis_off()
    axes.set_aspect('equal')
    axes.set_xlim(-0.5, 0.5)
    axes.set_ylim(-0.5 * HEIGHT / WIDTH, 0.5 * HEIGHT / WIDTH)
    _draw_legend(figure, config, colour, surface)
    save(figure, path)
    return label_panel(segmentation.label)[0]


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
    axes: Any, xyz: FloatArray, segmentation: Segmentation, camera: Place, colour: str
) -> None:
    """Draw far points first, and the ground below all obstacles."""
    place, depth = project(xyz, camera)
    for value, layer in ((Label.GROUND, 1), (Label.OBSTACLE, 4)):
        chosen = np.flatnonzero((segmentation.label == value) & (depth > CLOSEST))
        chosen = chosen[np.argsort(-depth[chosen])]
        look: dict[str, Any] = {'c': COLOURS[value.name.lower()], 'zorder': layer}
        if colour in VALUES:
            values = getattr(segmentation, colour)[chosen]
            look = {'c': ramp_colours(values, *VALUES[colour][1:]), 'zorder': 4}
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


def _draw_legend(figure: Any, config: Config, colour: str, surface: bool) -> None:
    """Draw the legend below the scene."""
    if colour in VALUES:
        title, low, high = VALUES[colour]
        colours = ramp_colours(np.linspace(low, high, 200), low, high)
        _draw_ramp(figure, f'{title}; mid-grey: no model', colours, (low, high))
        return
    dots = style.legend_dots({name: COLOURS[name] for name in ('ground', 'obstacle')}, 7)
    figure.legend(handles=dots, loc='lower left', fontsize=11, frameon=False, ncols=2)
    if surface:
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


def plot_birds_eye(
    points: npt.ArrayLike,
    label: Labels,
    path: str | Path,
    truth: Labels | None = None,
    title: str = '',
) -> str:
    """Draw points (N, >=3) [m] from above by their `Label`, as a PNG, replacing the file `path`.

    With the true labels, UNKNOWN where a point does not count, a second panel shows the errors.
    Returns the title of the last panel: the numbers of points in it.
    """
    xyz = check_points(points)
    style.check_lengths(len(xyz), label=label, truth=truth)
    panels = [label_panel(label)]
    if truth is not None:
        panels.append(error_panel(label, truth))
    xy = np.where(finite_points(xyz)[:, None], xyz[:, :2], np.nan)
    width = LEFT + SQUARE + RIGHT
    height = BELOW + SQUARE + ABOVE + (LINE if title else 0.0)
    figure = new_figure(width * len(panels), height)
    write_line(figure, title, 0.5, 0.6 * LINE, fontsize=15, fontweight='bold')
    for k, (panel_title, layers) in enumerate(panels):
        axes = add_axes(figure, k * width + LEFT, BELOW, (SQUARE, SQUARE))
        axes.set_title(panel_title, fontsize=11)
        _draw_panel(axes, xy, layers)
    save(figure, path)
    return panels[-1][0]


def label_panel(label: Labels) -> tuple[str, Layers]:
    """Return title and layers of the given labels."""
    shown = (Label.GROUND, Label.OBSTACLE, Label.UNKNOWN)
    layers = {value.name.lower(): label == value for value in shown}
    numbers = {name: int(chosen.sum()) for name, chosen in layers.items()}
    named = [f'{in_thousands(n)} {name}' for name, n in numbers.items() if n or name != 'unknown']
    return f'{in_thousands(len(label))} points: {", ".join(named)}', layers


def error_panel(label: Labels, truth: Labels) -> tuple[str, Layers]:
    """Return title and layers of the errors; each point is in one."""
    given, ground, obstacle = label == Label.GROUND, truth == Label.GROUND, truth == Label.OBSTACLE
    hit, missed, false = ground & given, ground & ~given, obstacle & given
    layers = {
        'not scored': ~(ground | obstacle),
        'right': hit | (obstacle & ~given),
        'missed ground': missed,
        'false ground': false,
    }
    n_hit, n_missed, n_false = (int(part.sum()) for part in (hit, missed, false))
    n_union = n_hit + n_missed + n_false
    iou = f', IoU {100.0 * n_hit / n_union:.2f} %' if n_union else ''
    return (
        f'{in_thousands(n_false)} false ground, {in_thousands(n_missed)} missed ground{iou}',
        layers,
    )


def _draw_panel(axes: Any, xy: npt.NDArray[np.floating], layers: Layers) -> None:
    """Draw points, rings of equal range and the sensor, forward up and left to the left."""
    inside = (np.abs(xy) <= EXTENT).all(axis=1)  # False where it is NaN.
    shown = {}
    for depth, (name, chosen) in enumerate(layers.items()):
        x, y = xy[chosen & inside].T
        if len(x):
            shown[name] = colour = COLOURS[name]
            size = 3.0 if name in ('missed ground', 'false ground') else 1.0
            axes.scatter(y, x, s=size, c=colour, linewidths=0.0, zorder=depth, rasterized=True)
    _draw_rings(axes, len(layers))
    axes.set_aspect('equal')
    axes.set_xlim(EXTENT, -EXTENT)
    axes.set_ylim(-EXTENT, EXTENT)
    axes.set_xlabel('y, to the left [m]')
    axes.set_ylabel('x, forward [m]')
    (sensor,) = axes.plot(
        0, 0, marker='^', color='white', markeredgecolor='black', linestyle='none',
        markersize=8, zorder=len(layers) + 1, label='sensor',
    )  # fmt: skip
    axes.legend(
        handles=[*style.legend_dots(shown, 7), sensor], loc='upper center', frameon=False,
        bbox_to_anchor=(0.5, -0.08), ncols=len(shown) + 1, fontsize=10.5, handletextpad=0.2,
        columnspacing=1.5,
    )  # fmt: skip


def _draw_rings(axes: Any, layer: int) -> None:
    """Draw rings of equal range, with their ranges."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    for radius in np.arange(RING_STEP, EXTENT * math.sqrt(2.0), RING_STEP):
        axes.plot(
            radius * np.cos(angle), radius * np.sin(angle), color='#6B7178', linewidth=0.5,
            linestyle=(0, (4, 4)), zorder=layer,
        )  # fmt: skip
        if radius < EXTENT:
            axes.text(
                *(-radius * math.sqrt(0.5),) * 2, f'{radius:g} m', fontsize=8, color='#3B4046',
                ha='center', va='center', zorder=layer,
                bbox={'boxstyle': 'round,pad=0.15', 'facecolor': 'white', 'edgecolor': 'none',
                      'alpha': 0.8},
            )  # fmt: skip
