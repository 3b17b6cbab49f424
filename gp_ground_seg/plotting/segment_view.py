"""The parts of a picture of one segment."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import OUTSIDE, Candidates, FloatArray, Label
from gp_ground_seg.gp.objective import N_SCALARS
from gp_ground_seg.result import Segmentation

# After Okabe and Ito's palette; the truth is light, so that what is estimated stands out.
POINT_COLOUR = '#B4BAC0'
TRUE_GROUND_COLOUR = '#E8CF9A'
TRUE_OBSTACLE_COLOUR = '#A9C4DA'
CANDIDATE_COLOUR = '#56636E'
INLIER_COLOUR = '#0072B2'
LINE_COLOUR = '#009E73'
SURFACE_COLOUR = '#D55E00'
PSEUDO_INPUT_COLOUR = '#7A4FA3'

# Metres kept free below and above the ground, and beyond the last candidate; and how far
# from the ground a candidate may be to be in the picture for certain.
BELOW, ABOVE, BEYOND, NEAR_GROUND = 0.25, 0.9, 2.0, 1.0


class SegmentView:
    """What there is to draw of one segment.

    Parameters
    ----------
    result : Segmentation
        A segmented scan.
    z : (N,) float64
        Heights of its points [m].
    segment : int
        Which segment.
    truth : (N,) uint8 or None
        True `Label` of each point, if it is known.
    """

    def __init__(
        self,
        result: Segmentation,
        z: FloatArray,
        segment: int,
        truth: npt.NDArray[np.uint8] | None,
    ) -> None:
        self._result = result
        self._segment = segment
        own = (result.grid.segment == segment) & (result.grid.bin != OUTSIDE)
        self._r, self._z = result.grid.r[own], z[own]
        self._truth = None if truth is None else truth[own]
        offsets = result.candidates.offsets
        self._candidates = slice(int(offsets[segment]), int(offsets[segment + 1]))
        self._mean, self._std = result.surface.mean[segment], result.surface.std[segment]

    def title(self, title: str) -> str:
        """Return `title` with the segment and where it looks."""
        n_segments = self._result.grid.n_segments
        first, last = (360.0 * (self._segment + k) / n_segments - 180.0 for k in (0, 1))
        place = f'segment {self._segment}, azimuth {first:g}° to {last:g}°'
        model = '' if np.isfinite(self._mean).any() else ': no ground model'
        return f'{title}{", " if title else ""}{place}{model}'

    def reach(self) -> float:
        """Range that holds all candidates, and all points where there are none [m]."""
        r = self._result.candidates.r[self._candidates]
        if len(r):
            return float(r[-1]) + BEYOND
        return float(self._r.max()) + BEYOND if len(self._r) else self._result.grid.edges[-1]

    def draw_heights(self, axes: Any, reach: float) -> None:
        """Draw points, candidates, lines and ground over range, up to `reach` [m]."""
        self._draw_points(axes)
        candidates = self._result.candidates
        r, z = candidates.r[self._candidates], candidates.z[self._candidates]
        inlier = self._result.surface.inlier[self._candidates]
        knots = self._result.surface.knots
        axes.fill_between(
            knots, self._mean - 2.0 * self._std, self._mean + 2.0 * self._std, linewidth=0.0,
            color=SURFACE_COLOUR, alpha=0.2, zorder=3, label='ground ± 2 std',
        )  # fmt: skip
        self._draw_lines(axes, candidates)
        axes.plot(knots, self._mean, color=SURFACE_COLOUR, lw=1.8, zorder=5, label='ground')
        axes.plot(
            r[~inlier], z[~inlier], 'o', ms=5.5, mfc='white', mec=CANDIDATE_COLOUR, mew=1.1,
            zorder=6, label=f'candidates, rejected ({np.count_nonzero(~inlier)})',
        )  # fmt: skip
        axes.plot(
            r[inlier], z[inlier], 'o', ms=5, color=INLIER_COLOUR, mew=0.0, zorder=7,
            label=f'candidates, inliers ({np.count_nonzero(inlier)})',
        )  # fmt: skip
        axes.set_xlim(0.0, reach)
        low, high = self._heights_shown(reach)
        axes.set_ylim(low, high)
        axes.set_ylabel('height z, sensor frame [m]')
        inside = self._r <= reach
        counts = {
            'above': np.count_nonzero(inside & (self._z > high)),
            'below': np.count_nonzero(inside & (self._z < low)),
            'beyond': np.count_nonzero(~inside),
        }
        outside = [f'{n} points {side}' for side, n in counts.items() if n]
        axes.annotate(
            f'not shown: {", ".join(outside)}' if outside else '', (1.0, 1.0), (0, 4),
            xycoords='axes fraction', textcoords='offset points', ha='right', va='bottom',
            fontsize=8.5, color=CANDIDATE_COLOUR,
        )  # fmt: skip

    def _heights_shown(self, reach: float) -> tuple[float, float]:
        """Limits around the ground as far as it rests on inliers, and candidates near it.

        Ground that is known to be elsewhere, but for a few points, is in them too.
        """
        candidates, surface = self._result.candidates, self._result.surface
        r, z = candidates.r[self._candidates], candidates.z[self._candidates]
        inlier_r = r[surface.inlier[self._candidates] & (r <= reach)]
        if not len(inlier_r):
            low, high = np.quantile(self._z, (0.0, 0.5)) if len(self._z) else (-2.0, 0.0)
            return float(low) - BELOW, float(high) + ABOVE
        known = (surface.knots >= inlier_r[0]) & (surface.knots <= inlier_r[-1])
        height = np.abs(z - np.interp(r, surface.knots, self._mean))
        near = z[(height <= NEAR_GROUND) & (r <= reach)]
        ground = np.concatenate([near, self._mean[known]])
        if self._truth is not None:
            true_ground = self._z[(self._truth == Label.GROUND) & (self._r <= reach)]
            if len(true_ground):
                ground = np.concatenate([ground, np.quantile(true_ground, (0.01, 0.99))])
        return float(ground.min()) - BELOW, float(ground.max()) + ABOVE

    def _draw_points(self, axes: Any) -> None:
        if self._truth is None:
            groups = [('points', POINT_COLOUR, np.ones(len(self._r), dtype=np.bool_))]
        else:
            groups = [
                (title, colour, self._truth == label)
                for title, colour, label in (
                    ('points, not scored', POINT_COLOUR, Label.UNKNOWN),
                    ('points, true obstacle', TRUE_OBSTACLE_COLOUR, Label.OBSTACLE),
                    ('points, true ground', TRUE_GROUND_COLOUR, Label.GROUND),
                )
            ]
        for title, colour, chosen in groups:
            if chosen.any():
                axes.plot(
                    self._r[chosen], self._z[chosen], 'o', ms=3.6, mew=0.0, color=colour,
                    zorder=2, label=f'{title} ({np.count_nonzero(chosen)})',
                )  # fmt: skip

    def _draw_lines(self, axes: Any, candidates: Candidates) -> None:
        """Each line over its extent, and the critical point that ends it: the next one's first."""
        lines = self._result.lines
        ids = np.unique(lines.line[self._candidates])
        title: str | None = f'lines ({len(ids)})'
        for q in ids:
            own = slice(int(lines.start[q]), int(lines.start[q + 1]))
            if own.stop - own.start < 2:
                continue
            r, z = line_ends(candidates.r[own], candidates.z[own], float(lines.slope[q]))
            axes.plot(
                r, z, color=LINE_COLOUR, lw=3.2, alpha=0.75, solid_capstyle='butt', zorder=4,
                label=title,
            )  # fmt: skip
            title = None
        critical = lines.start[ids[1:]]
        axes.plot(
            candidates.r[critical], candidates.z[critical], 'd', ms=9, mfc='none',
            mec=LINE_COLOUR, mew=1.2, zorder=8, label=f'critical points ({len(critical)})',
        )  # fmt: skip

    def draw_length_scale(self, axes: Any, reach: float, *, with_pseudo_inputs: bool) -> None:
        """Draw the length-scale over range, and the pseudo-inputs it follows."""
        result = self._result
        knots = result.surface.knots
        length_scale = np.exp(result.log_length_scale[self._segment])
        axes.plot(knots, length_scale, color=SURFACE_COLOUR, lw=1.8, label='length-scale')
        shown = length_scale[(knots <= reach) & np.isfinite(length_scale)]
        first, last = result.pseudo.offsets[self._segment : self._segment + 2]
        if with_pseudo_inputs and last > first:
            r_bar = result.pseudo.r_bar[first:last]
            surface_class = result.pseudo.surface_class[first:last]
            l_bar = np.exp(result.theta[self._segment, N_SCALARS + surface_class])
            axes.plot(
                r_bar, l_bar, 's', ms=5, color=PSEUDO_INPUT_COLOUR, mew=0.0,
                label=f'pseudo-inputs ({last - first})',
            )  # fmt: skip
            shown = np.concatenate([shown, l_bar[r_bar <= reach]])
        # At least a decade: ripples of a constant must not look like mountains. Set before the
        # scale, since on a log axis matplotlib warns of limits that a constant makes equal.
        low, high = (shown.min(), shown.max()) if len(shown) else (1.0, 10.0)
        factor = max(1.2 * math.sqrt(high / low), math.sqrt(10.0))
        axes.set_ylim(math.sqrt(low * high) / factor, math.sqrt(low * high) * factor)
        axes.set_yscale('log')
        axes.set_ylabel('length-scale l [m]')


def line_ends(r: FloatArray, z: FloatArray, slope: float) -> tuple[FloatArray, FloatArray]:
    """Return the ends of a line over its points, where the outer ones lie nearest to it.

    Parameters
    ----------
    r, z : (n,) float64
        Range and height of its points [m].
    slope : float
        Its slope; may be infinite.

    Returns
    -------
    r, z : (2,) float64
        Range and height of both ends [m].
    """
    angle = math.atan(slope)
    along = (r - r.mean()) * math.cos(angle) + (z - z.mean()) * math.sin(angle)
    ends = np.array([along.min(), along.max()])
    return r.mean() + ends * math.cos(angle), z.mean() + ends * math.sin(angle)
