"""One segment from the side: what the two processes made of it (the paper's Figure 1)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import ConfigError, MissingDependencyError, PointCloudError
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.pipeline.points import check_points
from gp_ground_seg.plotting.segment_view import SegmentView
from gp_ground_seg.result import Segmentation

FORMATS = ('.png', '.pdf')
DPI = 130
# Inches: the figure, and the part of it that the two panels leave to the legend.
WIDTH, HEIGHT, LEGEND = 12.2, 7.6, 2.6


def segment_at(azimuth: float, n_segments: int) -> int:
    """Segment that looks towards an azimuth [rad], counter-clockwise from x."""
    return math.floor((azimuth / math.tau + 0.5) * n_segments) % n_segments


def plot_segment(
    result: Segmentation,
    config: Config,
    points: npt.ArrayLike,
    segment: int,
    path: str | Path,
    truth: npt.NDArray[np.uint8] | None = None,
    title: str = '',
    max_range: float | None = None,
) -> None:
    """Draw a segment from the side as PNG or PDF, replacing the file `path`.

    Above: points, ground candidates, the lines through them with their critical
    points, inliers, and the surface with twice its standard deviation. Below:
    the length-scale and the pseudo-inputs it follows.

    Parameters
    ----------
    result : Segmentation
        What segmenting `points` gave.
    config : Config
        The parameters it was segmented with.
    points : (N, >=3) float array
        x forward, y left, z up [m].
    segment : int
        Which segment.
    path : str or Path
        File to write, .png or .pdf.
    truth : (N,) uint8, optional
        True `Label` of each point, UNKNOWN where it does not count.
    title : str
        Line above the panels, before the segment's number.
    max_range : float, optional
        Range shown [m]; by default a little more than that of the last candidate.

    Raises
    ------
    PointCloudError
        If the shapes do not fit together.
    ConfigError
        If the segment, the range or the ending of the file is not one accepted.
    MissingDependencyError
        If matplotlib is not installed.
    DataError
        If the file cannot be written.
    """
    z = result.pose.level(check_points(points))[:, 2].astype(np.float64)
    for name, label in (('result', result.label), ('truth', truth)):
        if label is not None and label.shape != (len(z),):
            raise PointCloudError(
                f'{name} of shape {label.shape} for {len(z)} points: must be ({len(z)},)'
            )
    n_segments = result.grid.n_segments
    if not 0 <= segment < n_segments:
        raise ConfigError(f'segment {segment}: must be in [0, {n_segments - 1}]')
    if max_range is not None and not (max_range > 0.0 and math.isfinite(max_range)):
        raise ConfigError(f'max_range = {max_range}: must be a positive number of metres')
    ending = Path(path).suffix.lower()
    if ending not in FORMATS:
        raise ConfigError(f'{path}: must end in {" or ".join(FORMATS)}')
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import LogLocator, NullFormatter
    except ImportError as error:
        raise MissingDependencyError(
            "drawing needs matplotlib: pip install 'gp_ground_seg[plot]'"
        ) from error

    view = SegmentView(result, z, segment, truth)
    reach = view.reach() if max_range is None else max_range
    figure = Figure((WIDTH, HEIGHT), dpi=DPI)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1.0))
    figure.subplots_adjust(0.065, 0.075, 1.0 - LEGEND / WIDTH, 0.93, hspace=0.08)
    above.set_title(view.title(title), fontsize=12, loc='left', parse_math=False)
    view.draw_heights(above, reach)
    latent = config.length_scale.model == 'latent'
    view.draw_length_scale(below, reach, with_pseudo_inputs=latent)
    below.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    below.yaxis.set_major_formatter('{x:g}')
    below.yaxis.set_minor_formatter(NullFormatter())
    below.set_xlabel('horizontal range r [m]')
    for axes in (above, below):
        axes.grid(color='#E9ECEE', linewidth=0.7)
        axes.set_axisbelow(True)
        axes.legend(
            loc='upper left', bbox_to_anchor=(1.01, 1.01), frameon=False, fontsize=10,
            borderaxespad=0.0, labelspacing=0.8, markerscale=1.3,
        )  # fmt: skip
    figure.align_ylabels()
    # A date would make every PDF another.
    metadata = {'CreationDate': None} if ending == '.pdf' else {}
    with staged_file(path, force=True) as part:
        figure.savefig(part, format=ending[1:], metadata=metadata)
