"""The paper's Figure 1: segments from the side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.core.frame import OUTSIDE, FloatArray
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.points import check_points
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.colours import COLOURS
from gp_ground_seg.lab.plotting.scan import GREEN, VIOLET, Layers, label_layers, new_figure, save
from gp_ground_seg.lab.scoring.metrics import Labels, check_lengths

DPI = 130
# Inches: the panels of one segment, those of each of several, and the legend beside them.
WIDTH, WIDTH_OF_SEVERAL, HEIGHT, LEGEND = 9.6, 7.2, 7.6, 2.6

CANDIDATE_COLOUR = '#56636E'
LINE_COLOUR = GREEN
SURFACE_COLOUR = '#111111'
PSEUDO_INPUT_COLOUR = VIOLET

# Metres kept free below and above the ground, and beyond the last candidate; and the distance
# from the ground up to which a candidate is always in the picture.
BELOW, ABOVE, BEYOND, NEAR_GROUND = 0.25, 0.9, 2.0, 1.0
N_OF_LINE = 16  # places at which a line is drawn over the relief


def segment_at(azimuth: float, n_segments: int) -> int:
    """Return the segment towards an azimuth [rad], counter-clockwise from x."""
    return math.floor((azimuth / math.tau + 0.5) * n_segments) % n_segments


def plot_segment(
    result: Segmentation,
    config: Config,
    points: npt.ArrayLike,
    segments: Sequence[int],
    path: str | Path,
    truth: Labels | None = None,
    title: str = '',
) -> None:
    """Draw segments from the side, side by side; below each the length-scale and pseudo-inputs.

    `result` is the segmentation of `points`, (N, >=3) [m], under `config`. `truth` (N,) are true
    labels, UNKNOWN where a point does not count. The range is a little more than that of the last
    candidate. The file `path`, a PDF or else a PNG, is replaced.
    """
    z = result.pose.level(check_points(points))[:, 2].astype(np.float64)
    check_lengths(len(z), result=result.label, truth=truth)
    views = [SegmentView(result, segment) for segment in segments]
    inside = [
        (result.grid.segment == segment) & (result.grid.bin != OUTSIDE) for segment in segments
    ]
    points_of = [(result.grid.r[part], z[part]) for part in inside]
    reach = max(v.reach(r) for v, (r, _) in zip(views, points_of, strict=True))
    shown = [v.heights_shown(reach, z) for v, (_, z) in zip(views, points_of, strict=True)]
    low, high = min(low for low, _ in shown), max(high for _, high in shown)
    figure, panels = _panels(len(views))
    scales, with_pseudo_inputs = [], config.length_scale.model == 'latent'
    for view, (r, z), part, (above, below) in zip(views, points_of, inside, panels.T, strict=True):
        n_hidden = np.count_nonzero((r > reach) | (z < low) | (z > high))
        name = f'{title}, {view.name}' if title else view.name
        name = f'{name}; {n_hidden} points outside'
        above.set_title(name, fontsize=12, loc='left', parse_math=False)
        _, kinds = label_layers(result.label[part], None if truth is None else truth[part])
        view.draw_points(above, r, z, kinds)
        view.draw_ground(above)
        view.draw_length_scale(below, reach, with_pseudo_inputs=with_pseudo_inputs)
        scales.append(below.get_ylim())
        title = ''
    panels[0, 0].set_xlim(0.0, reach)
    panels[0, 0].set_ylim(low, high)
    panels[1, 0].set_ylim(min(low for low, _ in scales), max(high for _, high in scales))
    for axes in panels.flat:
        _finish(axes, has_legend=axes in panels[:, -1], with_counts=len(views) == 1)
    figure.align_ylabels()
    save(figure, path)


def _panels(n: int) -> tuple[Any, Any]:
    """Return a figure and its panels, (2, n), with the same axes in each row."""
    width = LEGEND + (WIDTH if n == 1 else n * WIDTH_OF_SEVERAL)
    figure = new_figure(width, HEIGHT, DPI)
    shared = {'sharex': True, 'sharey': 'row', 'squeeze': False}
    panels = figure.subplots(2, n, height_ratios=(2.6, 1.0), **shared)
    edge = 0.065 * (WIDTH + LEGEND) / width
    figure.subplots_adjust(edge, 0.075, 1.0 - LEGEND / width, 0.93, hspace=0.08, wspace=0.04)
    return figure, panels


def _finish(axes: Any, *, has_legend: bool, with_counts: bool) -> None:
    """Draw the grid of a panel, and beside the last one the legend, with its counts."""
    axes.grid(color='#E9ECEE', linewidth=0.7)
    axes.set_axisbelow(True)
    axes.label_outer()
    if not has_legend:
        return
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(
        handles, labels if with_counts else [label.split(' (')[0] for label in labels],
        loc='upper left', bbox_to_anchor=(1.01, 1.01), frameon=False, fontsize=10,
        borderaxespad=0.0, labelspacing=0.8, markerscale=1.3,
    )  # fmt: skip


class SegmentView:
    """The parts of the picture of a segment; ConfigError if there is no such segment."""

    def __init__(self, result: Segmentation, segment: int) -> None:
        n_segments = result.grid.n_segments
        if not 0 <= segment < n_segments:
            raise ConfigError(f'segment {segment}: must be in [0, {n_segments - 1}]')
        self._result, self._segment = result, segment
        first, last = result.candidates.offsets[segment : segment + 2].tolist()
        own = result.candidates.where(result.candidates.segment == segment)
        self._r, self._z = own.r, own.z + result.relief.at(own.x, own.y)
        self._inlier = result.surface.inlier[first:last]
        self._lines = np.unique(result.lines.line[first:last])
        self._knots = result.surface.knots
        self._std = result.surface.std[segment]
        self._mean = result.surface.mean[segment] + self._relief(self._knots)

    @property
    def name(self) -> str:
        """Number of the segment and its azimuths, and whether it has a ground model."""
        width = 360.0 / self._result.grid.n_segments
        first, last = (width * (self._segment + k) - 180.0 for k in (0, 1))
        model = '' if np.isfinite(self._mean).any() else ': no ground model'
        return f'segment {self._segment}, azimuth {first:g}° to {last:g}°{model}'

    def _relief(self, r: FloatArray) -> FloatArray:
        """Height of the relief at ranges (K,) in the middle of the segment, (K,) [m]."""
        heights = self._result.relief.at_knots(r, self._result.grid.n_segments)
        return np.asarray(heights[self._segment])

    def reach(self, point_r: FloatArray) -> float:
        """Return the range that holds all candidates, or if none all points [m]."""
        r = self._r if len(self._r) else point_r
        return float(r.max()) + BEYOND if len(r) else float(self._result.grid.edges[-1])

    def draw_points(self, axes: Any, r: FloatArray, z: FloatArray, kinds: Layers) -> None:
        """Draw points over range by label, and errors on them."""
        for name, chosen in kinds.items():
            look = {'color': COLOURS[name], 'label': f'{name} ({np.count_nonzero(chosen)})'}
            axes.plot(r[chosen], z[chosen], 'o', ms=3.6, mew=0, zorder=2, **look)

    def draw_ground(self, axes: Any) -> None:
        """Draw ground, lines and candidates over range."""
        low, high = self._mean - 2.0 * self._std, self._mean + 2.0 * self._std
        look = {'linewidth': 0.0, 'color': SURFACE_COLOUR, 'alpha': 0.15, 'zorder': 3}
        axes.fill_between(self._knots, low, high, label='surface ± 2 std', **look)
        self._draw_lines(axes)
        axes.plot(self._knots, self._mean, color=SURFACE_COLOUR, lw=1.8, zorder=5, label='surface')
        hollow = {'mfc': 'white', 'mec': CANDIDATE_COLOUR, 'mew': 1.1, 'ms': 5.5, 'zorder': 6}
        full = {'color': CANDIDATE_COLOUR, 'mew': 0.0, 'ms': 5.5, 'zorder': 7}
        groups = (('rejected', ~self._inlier, hollow), ('inliers', self._inlier, full))
        for name, chosen, look in groups:
            label = f'candidates, {name} ({np.count_nonzero(chosen)})'
            axes.plot(self._r[chosen], self._z[chosen], 'o', label=label, **look)
        axes.set_ylabel('height z, sensor frame [m]')

    def heights_shown(self, reach: float, point_z: FloatArray) -> tuple[float, float]:
        """Limits around the candidates near the ground, as far as it rests on inliers [m]."""
        if not (self._inlier & (self._r <= reach)).any():
            low, high = np.quantile(point_z, (0.0, 0.5)) if len(point_z) else (-2.0, 0.0)
            return float(low) - BELOW, float(high) + ABOVE
        height = np.abs(self._z - np.interp(self._r, self._knots, self._mean))
        near = self._z[(height <= NEAR_GROUND) & (self._r <= reach)]
        return float(near.min()) - BELOW, float(near.max()) + ABOVE

    def _draw_lines(self, axes: Any) -> None:
        """Draw each line over its extent, and the critical points where the next one begins."""
        candidates, lines = self._result.candidates, self._result.lines
        drawn = [q for q in self._lines if lines.start[q + 1] - lines.start[q] > 1]
        for q in drawn:
            points = slice(lines.start[q], lines.start[q + 1])
            r, z = candidates.r[points], candidates.z[points]
            share = np.linspace(0.0, 1.0, N_OF_LINE)
            r, z = (a + share * (b - a) for a, b in line_ends(r, z, float(lines.slope[q])))
            axes.plot(
                r, z + self._relief(r),
                color=LINE_COLOUR, lw=3.2, alpha=0.75, solid_capstyle='butt', zorder=4,
                label=f'lines ({len(self._lines)})' if q == drawn[0] else None,
            )  # fmt: skip
        critical = lines.start[self._lines[1:]]
        first = self._result.candidates.offsets[self._segment]
        axes.plot(
            self._r[critical - first], self._z[critical - first], 'd', ms=9, mfc='none',
            mec=LINE_COLOUR, mew=1.2, zorder=8, label=f'critical points ({len(critical)})',
        )  # fmt: skip

    def draw_length_scale(self, axes: Any, reach: float, *, with_pseudo_inputs: bool) -> None:
        """Draw the length-scale over range, and the pseudo-inputs it follows."""
        from matplotlib.ticker import LogLocator, NullFormatter

        result = self._result
        length_scale = np.exp(result.log_length_scale[self._segment])
        axes.plot(self._knots, length_scale, color=SURFACE_COLOUR, lw=1.8, label='length-scale')
        shown = length_scale[(self._knots <= reach) & np.isfinite(length_scale)]
        first, last = result.pseudo.offsets[self._segment : self._segment + 2]
        if with_pseudo_inputs and last > first:
            r_bar = result.pseudo.r_bar[first:last]
            shared = result.theta[5 + result.pseudo.kind[first:last]]
            l_bar = np.exp(result.pseudo.log_extent[first:last] + shared)
            look = {'ms': 5, 'color': PSEUDO_INPUT_COLOUR, 'mew': 0.0}
            axes.plot(r_bar, l_bar, 's', label=f'pseudo-inputs ({last - first})', **look)
            shown = np.concatenate([shown, l_bar[r_bar <= reach]])
        # At least a decade: ripples of a constant must not look like mountains. Set before the
        # scale, since on a log axis matplotlib warns of limits that a constant makes equal.
        low, high = (shown.min(), shown.max()) if len(shown) else (1.0, 10.0)
        factor = max(1.2 * math.sqrt(high / low), math.sqrt(10.0))
        axes.set_ylim(math.sqrt(low * high) / factor, math.sqrt(low * high) * factor)
        axes.set_yscale('log')
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter('{x:g}')
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel('horizontal range r [m]')
        axes.set_ylabel('length-scale l [m]')


def line_ends(r: FloatArray, z: FloatArray, slope: float) -> tuple[FloatArray, FloatArray]:
    """Return range and height, (2,) each, of the ends of a line through points (n,) [m]."""
    angle = math.atan(slope)
    along = (r - r.mean()) * math.cos(angle) + (z - z.mean()) * math.sin(angle)
    ends = np.array([along.min(), along.max()])
    return r.mean() + ends * math.cos(angle), z.mean() + ends * math.sin(angle)
