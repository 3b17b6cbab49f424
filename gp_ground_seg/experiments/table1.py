"""The paper's Table I: hyper-parameters, errors and times for segments of real frames."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.semantic_kitti import Frame, list_frames, read_labels, read_points
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation.conventions import GROUNDGRID
from gp_ground_seg.evaluation.height_error import height_error
from gp_ground_seg.frame import OUTSIDE, FloatArray, Label, PolarGrid
from gp_ground_seg.gp.objective import N_SCALARS
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.result import FitReport, Segmentation
from gp_ground_seg.segmenter import GroundSegmenter

MODELS = {'Z-L': 'latent', 'Z': 'line_gradient'}
"""The paper's method and the one it is compared with, as values of ``length_scale.model``."""

MIN_GROUND_POINTS = 100
"""Labelled ground points that a segment must have to be chosen by itself."""


@dataclass(frozen=True)
class Choice:
    """Segments of a frame; none named = the adjacent pair whose ground varies most in height."""

    sequence: str
    index: str
    segments: tuple[int, ...] = ()


DEFAULT_CHOICES = (Choice('10', '000000', (157, 158)), Choice('03', '000006', (147, 148)))
"""An adjacent pair that climbs a verge and a hill, 3 m over 30 m, and one on uneven ground."""


@dataclass(frozen=True)
class MethodColumns:
    """What one of the two methods did in one segment.

    Attributes
    ----------
    n_inliers : int
        Candidates of the segment that the surface rests on.
    variances : (5,) float64
        Learned sigma_f^2, sigma_n^2 [m^2], sigma_f_bar^2, sigma_l_bar^2 [m^2], sigma_n_bar^2.
    smse_in_sample : float
        Standardised mean squared error at the inliers.
    smse_held_out : float
        The same at the points labelled ground that are not candidates.
    seconds : float
        Median time for the whole frame.
    """

    n_inliers: int
    variances: FloatArray
    smse_in_sample: float
    smse_held_out: float
    seconds: float


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes
    ----------
    frame : Frame
        Which frame.
    segment : int
        Which of its segments.
    n_candidates, n_pseudo_inputs : int
        Ground candidates n_PG and pseudo-inputs n_L of the segment.
    n_held_out : int
        Points labelled ground in it that are not candidates.
    methods : dict of str to MethodColumns
        By key of `MODELS`.
    """

    frame: Frame
    segment: int
    n_candidates: int
    n_pseudo_inputs: int
    n_held_out: int
    methods: dict[str, MethodColumns]


@dataclass(frozen=True)
class Table1:
    """The rows, and the fit report of the last frame: backend and threads are in it."""

    rows: tuple[Row, ...]
    fit: FitReport


def find_frame(root: str | Path, choice: Choice) -> Frame:
    """Labelled frame of a choice.

    Raises
    ------
    DataError
        If it is not there or has no labels.
    """
    frames = list_frames(root, choice.sequence)
    for frame in frames:
        if frame.index == choice.index:
            if frame.labels_path is None:
                raise DataError(f'{frame.points_path}: has no labels')
            return frame
    raise DataError(
        f'{root}: no frame {choice.index} in sequence {choice.sequence}; '
        f'there are {frames[0].index} to {frames[-1].index}'
    )


def table1(
    root: str | Path,
    choices: Sequence[Choice],
    config: Config,
    n_repeats: int,
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[Sequence[Frame]], Iterable[Frame]] = iter,
) -> Table1:
    """Measure the table.

    Parameters
    ----------
    root : str or Path
        Folder in SemanticKITTI layout.
    choices : sequence of Choice
        Which segments; at least one choice.
    config : Config
        Parameters of both methods but for ``length_scale.model``.
    n_repeats : int
        Timed runs of each method on each frame, alternately, after one that does not count.
    clock : callable
        Source of seconds.
    progress : callable
        Wraps the frames to show how far it is, as tqdm does.

    Raises
    ------
    ConfigError
        If ``length_scale.model`` is not the default, nothing is learned, or a segment is out
        of range.
    DataError
        If a frame is missing or unlabelled.
    """
    if config.length_scale.model != MODELS['Z-L']:
        raise ConfigError(
            f'length_scale.model = {config.length_scale.model}: the table compares latent with '
            'line_gradient, leave it out'
        )
    if config.learning.mode == 'fixed':
        raise ConfigError('learning.mode = fixed: the table is of what is learned, leave it out')
    last = config.grid.n_segments - 1
    for choice in choices:
        for segment in choice.segments:
            if not 0 <= segment <= last:
                raise ConfigError(f'segment {segment}: must be in [0, {last}]')
    frames = [find_frame(root, choice) for choice in choices]
    rows: list[Row] = []
    with ExitStack() as stack:
        segmenters = {}
        for name, model in MODELS.items():
            own = GroundSegmenter(config.replace(**{'length_scale.model': model}), clock)
            segmenters[name] = stack.enter_context(closing(own))
        for frame, choice in zip(progress(frames), choices, strict=True):
            found, fit = _rows(frame, choice, segmenters, n_repeats)
            rows += found
    return Table1(tuple(rows), fit)


def _rows(
    frame: Frame, choice: Choice, segmenters: dict[str, GroundSegmenter], n_repeats: int
) -> tuple[list[Row], FitReport]:
    points = read_points(frame.points_path)
    assert frame.labels_path is not None, 'find_frame gives only labelled ones'
    semantic = read_labels(frame.labels_path, len(points))
    z = points[:, 2].astype(np.float64)
    is_ground = GROUNDGRID.truth(semantic, z) == Label.GROUND
    seconds: dict[str, list[float]] = {name: [] for name in segmenters}
    results: dict[str, Segmentation] = {}
    for k in range(n_repeats + 1):
        for name, segmenter in segmenters.items():
            segmenter.reset()
            results[name] = segmenter.segment(points)
            if k > 0:  # compiling and first allocations are not its speed
                seconds[name].append(results[name].timings['total'])
    # Grid, candidates and pseudo-inputs do not depend on the length-scale model.
    common = results['Z-L']
    level_z = common.pose.level(points[:, :3])[:, 2].astype(np.float64)
    held_out = is_ground & (common.grid.bin != OUTSIDE) & ~is_candidate(common, level_z)
    rows = []
    for segment in choice.segments or _most_varied_pair(frame, common.grid, z, is_ground):
        own = held_out & (common.grid.segment == segment)
        rows.append(
            Row(
                frame,
                segment,
                int(np.diff(common.candidates.offsets)[segment]),
                int(np.diff(common.pseudo.offsets)[segment]),
                int(own.sum()),
                {
                    name: _columns(result, segment, z, own, statistics.median(seconds[name]))
                    for name, result in results.items()
                },
            )
        )
    return rows, common.fit


def is_candidate(result: Segmentation, z: FloatArray) -> npt.NDArray[np.bool_]:
    """Tell which points are ground candidates, (N,) bool; `z` (N,) in the level frame [m]."""
    grid, candidates = result.grid, result.candidates
    n_bins = len(grid.edges) - 1
    lowest = np.full((2, grid.n_segments * n_bins), np.nan)
    lowest[:, candidates.segment * n_bins + candidates.bin] = candidates.r, candidates.z
    cell = np.maximum(grid.cell, 0)
    found: npt.NDArray[np.bool_] = (
        grid.inside & (grid.r == lowest[0, cell]) & (z == lowest[1, cell])
    )
    return found


def _columns(
    result: Segmentation,
    segment: int,
    z: FloatArray,
    held_out: npt.NDArray[np.bool_],
    seconds: float,
) -> MethodColumns:
    candidates = result.candidates
    own = result.surface.inlier & (candidates.segment == segment)
    at_inliers = PolarGrid(
        (candidates.segment[own] * result.grid.n_bins + candidates.bin[own]).astype(np.int32),
        candidates.r[own],
        result.grid.edges,
        result.grid.n_segments,
    )
    estimate, _ = result.surface.at(at_inliers)
    return MethodColumns(
        int(own.sum()),
        np.exp(2.0 * result.theta[segment, :N_SCALARS]),
        height_error(candidates.z[own], estimate).smse,
        height_error(z[held_out], result.ground_z[held_out]).smse,
        seconds,
    )


def _most_varied_pair(
    frame: Frame, grid: PolarGrid, z: FloatArray, is_ground: npt.NDArray[np.bool_]
) -> tuple[int, int]:
    """Adjacent segments whose labelled ground, in the lesser of the two, varies most in height."""
    seen = is_ground & (grid.bin != OUTSIDE)
    std = np.zeros(grid.n_segments)
    for segment in range(grid.n_segments):
        own = z[seen & (grid.segment == segment)]
        if len(own) >= MIN_GROUND_POINTS:
            std[segment] = own.std()
    lesser = np.minimum(std, np.roll(std, -1))
    first = int(lesser.argmax())
    if lesser[first] == 0.0:
        raise DataError(
            f'{frame.points_path}: no two adjacent segments with {MIN_GROUND_POINTS} points '
            'labelled ground; name segments'
        )
    return first, (first + 1) % grid.n_segments
