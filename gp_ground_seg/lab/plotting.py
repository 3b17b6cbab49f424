"""Pictures: a segmented scan in perspective, and the paper's Figure 1, segments from the side.

The page of `tune`, RViz and Foxglove use the same colours.

This is the only module that imports matplotlib. A function that draws raises
`MissingDependencyError` if it is not installed, and `DataError` if the file cannot be written.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import in_thousands, require
from gp_ground_seg.core.frame import OUTSIDE, BoolArray, FloatArray, Label
from gp_ground_seg.core.pipeline.points import take_points
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.files import staged_file, writing
from gp_ground_seg.lab.scoring.metrics import Labels, count_labels, label_ratios

COLOURS = {
    'ground': '#B9BFC6',
    'obstacle': '#D55E00',
    'unknown': '#E3E6E9',
    'missed ground': '#0072B2',
    'false ground': '#AA3377',
}
"""Colours of points by their label, and by what it is against the truth."""
DPI = 120
GREEN, VIOLET = '#009E73', '#7A4FA3'
"""Of Okabe and Ito's palette, and one that differs from it with any colour vision."""


def new_figure(width: float, height: float) -> Any:
    """Return an empty matplotlib figure [inch] outside pyplot's global state."""
    return require('matplotlib.figure', 'matplotlib').Figure((width, height), dpi=DPI)


def save(figure: Any, path: str | Path) -> None:
    """Write a figure in the format that `path` ends in, or as PNG, replacing the file."""
    kind = Path(path).suffix[1:].lower() or 'png'
    with staged_file(path, force=True) as part, writing(path):
        figure.savefig(part, format=kind)


# Size of the scene, and of the legend below it [inch].
WIDTH, HEIGHT, FOOT = 12.0, 6.0, 0.6
CLOSEST = 1.0
"""Nothing nearer to the camera than this is drawn [m]."""
# Places of the camera and of the middle of the picture, sensor frame [m].
CAMERA, TARGET = (-16.0, -7.0, 10.0), (12.0, 1.0, -3.0)
ZOOM = 0.75
"""Focal length over the width of the picture."""
REACH = 25.0
"""Range within which nine tenths of the points of a street are [m]: the camera suits these."""

Place = tuple[float, float, float]
Layers = dict[str, BoolArray]
"""Which points, (N,), are drawn in each of `COLOURS`, the lowest layer first."""


def plot_scan_view(
    points: npt.ArrayLike,
    label: Labels,
    path: str | Path,
    title: str = '',
    camera: Place | None = None,
    *,
    truth: Labels | None = None,
) -> str:
    """Draw a scan in perspective, replacing the file `path`; return numbers of points.

    Ground and obstacles of `points`, (N, >=3) [m], by their `Label`; with the true labels, UNKNOWN
    where a point does not count, the errors too. `camera` is in the sensor frame [m]; without one,
    it comes as near as the cloud is small. In a PDF or SVG points are pixels.
    """
    xyz = take_points(points).astype(np.float64)
    if camera is None:  # a cloud that is enlarged looks as from nearby
        reach = np.hypot(*xyz[np.isfinite(xyz).all(axis=1), :2].T)
        usual = np.quantile(np.append(reach, REACH), 0.9)
        xyz, camera = xyz * (REACH / np.clip(usual, CLOSEST, REACH)), CAMERA
    said, layers = label_layers(label, truth)
    figure, foot = new_figure(WIDTH, HEIGHT + FOOT), FOOT / (HEIGHT + FOOT)
    axes = figure.add_axes((0.0, foot, 1.0, 1.0 - foot))
    figure.text(
        0.5, 0.96, title, ha='center', parse_math=False, fontsize=14, backgroundcolor='white'
    )
    draw_scan(axes, xyz, layers, camera)
    figure.legend(loc='lower left', fontsize=11, frameon=False, ncols=4)
    save(figure, path)
    return said


def draw_scan(axes: Any, xyz: FloatArray, layers: Layers, camera: Place, dot: float = 1.0) -> None:
    """Draw layers of points (N, 3) in perspective; the least area of a dot is `dot`."""
    axes.set_axis_off()
    axes.set_xlim(-0.5, 0.5)
    axes.set_ylim(-0.5 * HEIGHT / WIDTH, 0.5 * HEIGHT / WIDTH)
    place, depth = project(xyz, camera)
    for name, layer in layers.items():
        chosen = np.flatnonzero(layer & (depth > CLOSEST))
        chosen = chosen[np.argsort(-depth[chosen])]  # far points first
        size = np.clip(60.0 * dot / depth[chosen], dot, 5.0 * dot)
        look = {'linewidths': 0.0, 'rasterized': True, 'c': COLOURS[name]}
        axes.scatter(*place[chosen].T, s=size, **look)
        # Dots as small as in the picture would show no colour in the legend.
        axes.plot([], [], 'o', markersize=7, color=COLOURS[name], label=name)


def words_of_pose(pose: SensorPose) -> str:
    """Return the height and tilt that were used, and whether they were estimated."""
    source = 'estimated' if pose.height_estimated else 'given'
    height = f'{pose.height:.2f} m over the ground'
    tilt = 'level' if pose.is_level else f'roll {pose.roll:.3f}, pitch {pose.pitch:.3f} rad'
    return f'{height} ({"assumed" if pose.is_height_default else source}), {tilt}'


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


def label_layers(label: Labels, truth: Labels | None = None) -> tuple[str, Layers]:
    """Return numbers of points in words, and the layers of their labels (N,).

    With the true labels, UNKNOWN where a point does not count, those of the errors.
    """
    layers = {'ground': label == Label.GROUND, 'obstacle': label == Label.OBSTACLE}
    if truth is None:
        counts = {name: int(layer.sum()) for name, layer in layers.items()}
        counts['unknown'] = len(label) - sum(counts.values())
        words = [f'{in_thousands(n)} {name}' for name, n in counts.items() if n or name in layers]
        return f'{in_thousands(len(label))} points: {", ".join(words)}', layers
    layers['missed ground'] = (truth == Label.GROUND) & ~layers['ground']
    layers['false ground'] = layers['ground'] & (truth == Label.OBSTACLE)
    n_false, n_missed = (
        in_thousands(layers[f'{kind} ground'].sum()) for kind in ('false', 'missed')
    )
    iou = 100.0 * label_ratios(count_labels(label, truth))['iou']
    score = f', IoU {iou:.2f} %' if np.isfinite(iou) else ''
    return f'{n_false} false ground, {n_missed} missed ground{score}', layers


CANDIDATE_COLOUR, LINE_COLOUR, SURFACE_COLOUR = '#56636E', GREEN, '#111111'

# Metres kept free below and above the ground, and beyond the last candidate.
BELOW, ABOVE, BEYOND = 0.4, 0.9, 2.0
N_OF_LINE, STEEPEST = 16, 1e6  # places at which a line is drawn over the relief; slope of a wall


def plot_segment(
    result: Segmentation,
    points: npt.ArrayLike,
    segments: Sequence[int],
    path: str | Path,
    truth: Labels | None = None,
    title: str = '',
) -> str:
    """Draw segments from the side, side by side; below each the length-scale and pseudo-inputs.

    `result` is the segmentation of `points`, (N, >=3) [m]. `truth` (N,) are true labels, UNKNOWN
    where a point does not count. The axes end a little beyond the last candidate. The file `path`
    is replaced. Return numbers of what is in them.
    """
    z = result.pose.level(take_points(points).astype(np.float64))[:, 2].astype(np.float64)
    views = [SegmentView(result, segment, z) for segment in segments]
    figure = new_figure(5.0 + 6.5 * len(views), 7.6)
    figure.set_layout_engine('constrained')
    shared = {'sharex': True, 'sharey': 'row', 'squeeze': False}
    panels = figure.subplots(2, len(views), height_ratios=(2.6, 1.0), **shared)
    for view, (above, below) in zip(views, panels.T, strict=True):
        name = f'{title}, {view.name}' if title and view is views[0] else view.name
        above.set_title(name, fontsize=12, loc='left', parse_math=False)
        view.draw_ground(above, truth)
        view.draw_length_scale(below)
    lows, highs = zip(*(view.heights for view in views), strict=True)
    panels[0, 0].set_xlim(0.0, max(view.reach for view in views))
    panels[0, 0].set_ylim(min(lows), max(highs))
    for axes in panels.flat:
        axes.grid(color='#E9ECEE', linewidth=0.7)
        axes.set_axisbelow(True)
        axes.label_outer()
    for axes in panels[:, -1]:
        axes.legend(loc='upper left', bbox_to_anchor=(1.01, 1.01), frameon=False)
    save(figure, path)
    return '; '.join(view.counts for view in views)


class SegmentView:
    """The parts of the picture of a segment; ConfigError if there is no such segment.

    `z` (N,) are the heights of all points in the level frame [m]; `r` and `z` of the view are
    ranges and heights of those in the segment.
    """

    def __init__(self, result: Segmentation, segment: int, z: FloatArray) -> None:
        own, grid = result.segment(segment), result.grid
        self._result, self._segment, self._own = result, segment, own
        self._inside = (grid.segment == segment) & (grid.bin != OUTSIDE)
        self.r, self.z = grid.r[self._inside], z[self._inside]
        first, last = (360.0 / grid.n_segments * (segment + k) - 180.0 for k in (0, 1))
        model = '' if len(own.knots) else ': no ground model'
        self.name = f'segment {segment}, azimuth {first:g}° to {last:g}°{model}'
        self.counts = (
            f'segment {segment}: {len(own.r)} candidates, {own.inlier.sum()} inliers, '
            f'{len(own.pseudo_r)} pseudo-inputs'
        )
        # What holds all candidates, or if none all points [m].
        r = own.r if len(own.r) else self.r
        self.reach = float(r.max()) + BEYOND if len(r) else float(grid.edges[-1])
        # What holds the inliers, or if none the lower half of the points [m].
        heights = own.z[own.inlier]
        if not len(heights):
            heights = np.quantile(self.z, (0.0, 0.5)) if len(self.z) else np.array([-2.0, 0.0])
        self.heights = float(heights.min()) - BELOW, float(heights.max()) + ABOVE

    def draw_ground(self, axes: Any, truth: Labels | None = None) -> None:
        """Draw the ground over points by label, with their errors if `truth` is known."""
        own, true = self._own, None if truth is None else truth[self._inside]
        for name, chosen in label_layers(self._result.label[self._inside], true)[1].items():
            look = {'color': COLOURS[name], 'label': name, 'zorder': 2}
            axes.plot(self.r[chosen], self.z[chosen], 'o', ms=3.6, mew=0, **look)
        low, high = own.mean - 2.0 * own.std, own.mean + 2.0 * own.std
        look = {'linewidth': 0.0, 'color': SURFACE_COLOUR, 'alpha': 0.15, 'zorder': 3}
        axes.fill_between(own.knots, low, high, label='surface ± 2 std', **look)
        self._draw_lines(axes)
        axes.plot(own.knots, own.mean, color=SURFACE_COLOUR, lw=1.8, zorder=5, label='surface')
        for name, chosen, inner in (
            ('rejected', ~own.inlier, 'white'),
            ('inliers', own.inlier, CANDIDATE_COLOUR),
        ):
            look = {'mfc': inner, 'mec': CANDIDATE_COLOUR, 'ms': 5.5, 'zorder': 7}
            label = f'candidates, {name}'
            axes.plot(own.r[chosen], own.z[chosen], 'o', label=label, **look)
        axes.set_ylabel('height z, sensor frame [m]')

    def _draw_lines(self, axes: Any) -> None:
        """Draw each line over its extent, and the critical points where the next one begins."""
        candidates, lines = self._result.candidates, self._result.lines
        first, last = candidates.offsets[self._segment : self._segment + 2]
        numbers = np.unique(lines.line[first:last])
        label: str | None = 'lines'
        for q in numbers[np.diff(lines.start)[numbers] > 1]:
            points = slice(lines.start[q], lines.start[q + 1])
            own_r, own_z = candidates.r[points], candidates.z[points]
            r = np.linspace(own_r[0], own_r[-1], N_OF_LINE)
            slope = np.clip(lines.slope[q], -STEEPEST, STEEPEST)
            z = np.clip(own_z.mean() + slope * (r - own_r.mean()), own_z.min(), own_z.max())
            z += self._result.relief.at_knots(r, self._result.grid.n_segments)[self._segment]
            axes.plot(r, z, color=LINE_COLOUR, lw=3.2, alpha=0.75, zorder=4, label=label)
            label = None  # one entry in the legend for all
        critical = lines.start[numbers[1:]] - first
        axes.plot(
            self._own.r[critical], self._own.z[critical], 'd', ms=9, mfc='none', mec=LINE_COLOUR,
            zorder=8, label='critical points',
        )  # fmt: skip

    def draw_length_scale(self, axes: Any) -> None:
        """Draw the length-scale over range, its limits, and the pseudo-inputs it follows."""
        from matplotlib.ticker import LogLocator

        own, limits = self._own, self._result.config.length_scale
        axes.plot(own.knots, own.length_scale, color=SURFACE_COLOUR, lw=1.8, label='length-scale')
        if limits.model == 'latent':
            look = {'ms': 5, 'color': VIOLET, 'mew': 0.0, 'label': 'pseudo-inputs'}
            axes.plot(own.pseudo_r, own.pseudo_l, 's', **look)
        for limit in (limits.min, limits.max):
            axes.axhline(limit, color=SURFACE_COLOUR, lw=0.8, ls=':')
        axes.set_yscale('log')
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter('{x:g}')
        axes.set_xlabel('horizontal range r [m]')
        axes.set_ylabel('length-scale l [m]')
