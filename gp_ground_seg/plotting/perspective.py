"""A segmented scan in perspective, with the ground model on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import FloatArray, Label
from gp_ground_seg.ground_model import GroundModel
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.pipeline.points import check_points, finite_points
from gp_ground_seg.plotting import style
from gp_ground_seg.plotting.style import add_axes, length_scale_colours
from gp_ground_seg.result import Segmentation

COLOURS = {'ground': '#B9BFC6', 'obstacles': style.VERMILION}
WIDTH, HEIGHT, TITLE = 12.0, 6.0, 0.4
"""Size of the picture, and of the line above it [inch]."""
N_STD = 2.0
N_PROFILES = 60
CLOSEST = 1.0
"""Nothing nearer to the camera than this is drawn [m]."""
# Places of the camera and of the middle of the picture, sensor frame [m].
CAMERA, TARGET = (-16.0, -7.0, 10.0), (12.0, 1.0, -3.0)
ZOOM = 0.75
"""Focal length over the width of the picture."""


def plot_scan_view(
    points: npt.ArrayLike,
    segmentation: Segmentation,
    config: Config,
    path: str | Path,
    title: str = '',
) -> None:
    """Draw a scan in perspective as a PNG, replacing the file `path`.

    Ground and obstacles, and on them profiles of the ground model with two standard
    deviations, coloured by length-scale: what the node's topics show in RViz.

    Parameters
    ----------
    points : (N, >=3) float array
        The scan, x forward, y left, z up [m].
    segmentation, config : Segmentation, Config
        Its segmentation and the parameters of that; ``length_scale.min`` and ``max`` end the
        colours, ``label.ground_tolerance`` the profiles: less certain ground is not drawn.

    Raises
    ------
    PointCloudError
        If the scan is another one than was segmented.
    """
    xyz = check_points(points)
    finite = finite_points(xyz)
    style.check_lengths(len(xyz), label=segmentation.label)
    figure = style.new_figure(WIDTH, HEIGHT + (TITLE if title else 0.0))
    axes = add_axes(figure, 0.0, 0.0, (WIDTH, HEIGHT))
    style.write_line(figure, title, 0.5, 0.5 * TITLE, fontsize=14)
    _draw_points(axes, xyz[finite], segmentation.label[finite])
    _draw_profiles(axes, GroundModel.of(segmentation), config)
    _draw_legend(figure, axes, config)
    axes.set_axis_off()
    axes.set_aspect('equal')
    axes.set_xlim(-0.5, 0.5)
    axes.set_ylim(-0.5 * HEIGHT / WIDTH, 0.5 * HEIGHT / WIDTH)
    style.save(figure, path)


def project(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return places in the picture and depths [m] of points, (..., 2) and (...).

    A place is in widths of the picture, right and up of its middle; NaN nearer than `CLOSEST`.
    """
    forward = np.subtract(TARGET, CAMERA)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (points - CAMERA) @ np.stack([right, np.cross(right, forward), forward]).T
    depth: FloatArray = seen[..., 2]
    safe = np.where(depth > CLOSEST, depth, np.nan)
    place: FloatArray = ZOOM * seen[..., :2] / safe[..., None]
    return place, depth


def _draw_points(axes: Any, xyz: FloatArray, label: npt.NDArray[np.uint8]) -> None:
    """Draw far points first, and the ground below all obstacles."""
    place, depth = project(xyz)
    labels_and_layers = ((Label.GROUND, 1), (Label.OBSTACLE, 4))
    for colour, (value, layer) in zip(COLOURS.values(), labels_and_layers, strict=True):
        chosen = np.flatnonzero((label == value) & (depth > CLOSEST))
        chosen = chosen[np.argsort(-depth[chosen])]
        axes.scatter(
            *place[chosen].T, s=np.clip(40.0 / depth[chosen], 0.4, 4.0), c=colour,
            linewidths=0.0, zorder=layer,
        )  # fmt: skip


def _draw_profiles(axes: Any, model: GroundModel, config: Config) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    last = len(model.height) - 1
    rows = np.unique(np.linspace(0, last, min(last + 1, N_PROFILES)).round()).astype(int)
    middle, lower, upper = (
        project(model.knot_points(n_std)[rows])[0] for n_std in (0.0, -N_STD, N_STD)
    )
    certain = model.std[rows] <= config.label.ground_tolerance
    shown = certain & np.isfinite(upper + lower + middle).all(axis=-1)
    piece = shown[:, :-1] & shown[:, 1:]
    limits = config.length_scale
    colours = length_scale_colours(model.length_scale[rows], limits.min, limits.max)
    colours = colours[:, :-1][piece]
    corners = [lower[:, :-1], lower[:, 1:], upper[:, 1:], upper[:, :-1]]
    quads = np.stack([corner[piece] for corner in corners], axis=1)
    ends = np.stack([middle[:, :-1][piece], middle[:, 1:][piece]], axis=1)
    axes.add_collection(
        PolyCollection(list(quads), facecolors=colours, alpha=0.35, linewidths=0.0, zorder=2)
    )
    axes.add_collection(LineCollection(list(ends), colors=colours, linewidths=1.3, zorder=3))


def _draw_legend(figure: Any, axes: Any, config: Config) -> None:
    from matplotlib.patches import Rectangle

    dots = style.legend_dots(COLOURS, 7)
    legend = axes.legend(handles=dots, loc='upper left', fontsize=11, framealpha=0.85)
    legend.set_zorder(5)
    plate = Rectangle((0.205, -0.5 * HEIGHT / WIDTH + 0.008), 0.285, 0.068)
    plate.set(facecolor='white', edgecolor='#CCCCCC', alpha=0.85, zorder=5)
    axes.add_patch(plate)
    bar = add_axes(figure, 0.72 * WIDTH, 0.40, (0.255 * WIDTH, 0.16))
    low, high = config.length_scale.min, config.length_scale.max
    colours = length_scale_colours(np.geomspace(low, high, 200), low, high)
    bar.pcolormesh(np.geomspace(low, high, 201), [0.0, 1.0], colours[None])
    bar.set_xscale('log')
    bar.set_yticks([])
    bar.set_title('length-scale of the ground [m]; ribbons: 2 sigma', fontsize=10)
    ticks = [tick for tick in (0.1, 0.3, 1, 3, 10, 30, 100, 300) if low <= tick <= high]
    bar.set_xticks(ticks, labels=[f'{tick:g}' for tick in ticks])
    bar.minorticks_off()
