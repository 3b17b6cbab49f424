"""Ablations: length-scale models, ways to learn, and each departure from the paper undone."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.evaluate import ALL, KnownScan, MethodScore, Progress, load_kitti
from gp_ground_seg.evaluation.table import Column, Row, Table, centimetres, milliseconds, percent
from gp_ground_seg.experiments.variants import (
    Changes,
    Report,
    SimulatedFrame,
    load_simulated,
    make_report,
    refuse_changed,
    score_variants,
    simulated_frames,
)
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.simulation import SCENES

_FIXED: Changes = {'learning.mode': 'fixed'}
_WHOLE_FRAME: Changes = {'learning.mode': 'every_frame', 'learning.scope': 'frame'}
_PER_SEGMENT: Changes = {'learning.mode': 'every_frame', 'learning.scope': 'segment'}
_CONSTANT: Changes = {'length_scale.model': 'constant'}
_GRADIENT: Changes = {'length_scale.model': 'line_gradient'}
_LATENT: Changes = {'length_scale.model': 'latent'}

MODELS: dict[str, Changes] = {
    'constant, not learned': {**_CONSTANT, **_FIXED},
    'constant, learned': {**_CONSTANT, **_WHOLE_FRAME},
    'Z, not learned': {**_GRADIENT, **_FIXED},
    'Z, learned': {**_GRADIENT, **_WHOLE_FRAME},
    'Z-L, not learned': {**_LATENT, **_FIXED},
    'Z-L, learned per segment': {**_LATENT, **_PER_SEGMENT},
    'Z-L, learned over the frame': {**_LATENT, **_WHOLE_FRAME},
}
"""Length-scale models and ways to learn on labelled frames; the last one is the paper's."""

SIMULATED_MODELS: dict[str, Changes] = {
    **{
        f'constant, {length:g} m': {**_CONSTANT, 'length_scale.constant': length, **_WHOLE_FRAME}
        for length in (10.0, 5.0, 2.0, 1.0)
    },
    'line gradient': {**_GRADIENT, **_WHOLE_FRAME},
    'latent, not learned': {**_LATENT, **_FIXED},
    'latent': {**_LATENT, **_WHOLE_FRAME},
}
"""The same on simulated scans. A constant cannot be learned: several are given, so that the
best of them is known in hindsight."""

SCENE = 'road_then_rubble'
PLACES = (0.0, 6.0, 12.0)
"""Where the sensor stands on the road [m]; the rubble begins at 14 to 20 m."""
STRETCHES = (ALL, 'smooth', 'rubble')
"""All ground, the road before the rubble begins, and the rubble where it has its full height."""


class Departure(NamedTuple):
    """A departure from the paper, or another choice; `kept` if the defaults have it.

    `changes` are the parameters that switch it off; where it is not kept, on.
    """

    title: str
    changes: Changes
    kept: bool = True


_PLAIN_BAND: Changes = {
    'label.roughness_gain': 0.0,
    'label.obstacle_roughness_gain': 0.0,
    'label.ground_tolerance': 0.2,
}

DEPARTURES: tuple[Departure, ...] = (
    Departure('latent length-scales (constant instead)', {'length_scale.model': 'constant'}),
    Departure('learning in every frame', {'learning.mode': 'fixed'}),
    Departure('objective without the latent terms', {'learning.objective': 'paper'}),
    Departure('sloping mean', {'observation.slope_std': 0.0}),
    Departure('neighbouring segments fused', {'surface.n_neighbours': 0}),
    Departure('asymmetric gate of the growth', {'growth.max_standardised_depth': 2.0}),
    Departure('vertical faces', {'faces.min_height': 100.0}),
    Departure('vertical faces with occluded base', {'faces.max_foot_distance': 0.0}),
    Departure('band that follows the roughness', _PLAIN_BAND),
    Departure('narrower band beside an obstacle', {'label.obstacle_tolerance': 0.2}),
    Departure('band open downwards', {'label.below_tolerance': 0.2}),
    Departure('bins that widen, 80 of them', {'grid.n_bins': 120, 'grid.bin_growth': 1.0}),
    Departure('lines end at 0.1 rad', {'lines.slope_tolerance': 0.02}),
    Departure('length-scales of classes learned', {'learning.fixed': 'length_scales'}),
    Departure('lines continued outside the gate', {'growth.max_line_slope': 0.0}),
    Departure('lines continued past a slope break', {'growth.min_bend_extent': 1000.0}),
    Departure('learning from every third segment', {'learning.segment_step': 1}),
    Departure('one theta for the frame', {'learning.scope': 'segment'}),
    Departure('240 segments', {'grid.n_segments': 240}, kept=False),
    Departure('twice the neighbours fused', {'surface.n_neighbours': 4}, kept=False),
    Departure('a wider gate (3)', {'growth.max_standardised_residual': 3.0}, kept=False),
    Departure('vertical faces from 0.3 m on', {'faces.min_height': 0.3}, kept=False),
)
"""What `departures` measures. A new row here is all that a further one takes."""

AS_GIVEN = 'as given'


def compare_models(frames: Sequence[Frame], config: Config, progress: Progress = iter) -> Report:
    """Score `MODELS` on labelled frames; ConfigError if `config` sets what they set."""
    scores = _score_models(MODELS, frames, load_kitti, config, progress)
    rows: list[Row] = [
        [
            (Column('method'), one.name),
            (percent('IoU [%]', 'iou'), one.iou),
            *_worst(one),
            (centimetres('RMSE [cm]', 'rmse'), one.height().rmse),
            (centimetres('median [cm]', 'median_absolute'), one.height().median_absolute),
            (Column('SMSE', '.5f', 'smse'), one.height().smse),
            (milliseconds('ms', 'seconds'), one.seconds()),
        ]
        for one in scores
    ]
    title = f'{_frames_title(frames)}; heights under points labelled ground'
    return make_report({'models': Table.of(rows, title=title)}, scores, config, changes=MODELS)


def compare_models_simulated(n_seeds: int, config: Config, progress: Progress = iter) -> Report:
    """Score `SIMULATED_MODELS` by exact heights on a smooth road that ends in rubble.

    Each seed is a scene of its own, seen by an HDL-64E from `PLACES`. Raises as `compare_models`.
    """
    frames = simulated_frames(['hdl-64e'], [SCENE], n_seeds, PLACES)
    scores = _score_models(SIMULATED_MODELS, frames, load_stretches, config, progress)
    rows: list[Row] = [
        [
            (Column('length-scale'), one.name),
            *(
                (centimetres(f'{title}, {part}', f'{key}_{part}'), getattr(one.height(part), key))
                for title, key in (('RMSE', 'rmse'), ('median', 'median_absolute'))
                for part in STRETCHES
            ),
            (milliseconds('ms', 'seconds'), one.seconds()),
        ]
        for one in scores
    ]
    title = (
        f'{len(frames)} simulated scans of {n_seeds} scenes, road then rubble, HDL-64E; '
        'errors against the exact ground [cm]'
    )
    tables = {'models': Table.of(rows, title=title)}
    return make_report(tables, scores, config, changes=SIMULATED_MODELS)


def _score_models(
    models: Mapping[str, Changes],
    items: Sequence[Any],
    load: Callable[[Any], KnownScan],
    config: Config,
    progress: Progress,
) -> list[MethodScore]:
    refuse_changed(config, {name for changes in models.values() for name in changes})
    variants = {name: config.replace(**changes) for name, changes in models.items()}
    return score_variants(items, load, variants, progress=progress)


def load_stretches(frame: SimulatedFrame) -> KnownScan:
    """Simulate a scan whose ground has `STRETCHES`: the rubble's break lines lie across x."""
    scan = load_simulated(frame)
    begin, full = np.sort(SCENES[frame.scene](frame.seed).terrain.breaks()[:, 2])
    ground_x, is_ground = scan.points[:, 0] + frame.x, scan.parts[ALL]
    scan.parts['smooth'] = is_ground & (ground_x < begin)
    scan.parts['rubble'] = is_ground & (ground_x > full)
    return scan


def compare_departures(
    frames: Sequence[Frame],
    departures: Sequence[Departure],
    config: Config,
    progress: Progress = iter,
) -> Report:
    """Switch one departure after the other, on the same frames in the same run.

    Raises ConfigError if two titles are alike, a switch is not accepted or changes nothing.
    """
    variants = {AS_GIVEN: config}
    for one in departures:
        if one.title in variants:
            raise ConfigError(f'departure {one.title!r}: there is one of that title already')
        variants[one.title] = config.replace(**one.changes)
        if variants[one.title] == config:
            raise ConfigError(f'departure {one.title!r}: its switch changes nothing')
    scores = score_variants(frames, load_kitti, variants, progress=progress)
    given, *switched = scores

    def row(score: MethodScore, switch: str | None = None, worth: float | None = None) -> Row:
        pairs = zip(score.scans, given.scans, strict=True)
        time_ratio = statistics.median(one.seconds / other.seconds for one, other in pairs)
        return [
            (Column('departure'), score.name),
            (Column('switch'), switch),
            (percent('IoU [%]', 'iou'), score.iou),
            (percent('worth [%]', 'worth', '+.2f'), worth),
            *_worst(score),
            (centimetres('RMSE [cm]', 'rmse'), score.height().rmse),
            (Column('time', '.2f', 'time_ratio'), time_ratio),
        ]

    switches = []
    for one, score in zip(departures, switched, strict=True):
        gain = given.iou - score.iou
        switches.append((score, 'off', gain) if one.kept else (score, 'on', -gain))
    rows = [row(given), *(row(*one) for one in sorted(switches, key=lambda one: -one[2]))]
    title = (
        f'{_frames_title(frames)}; worth: what having it adds to the IoU; RMSE of the height; '
        'time: over that as given, median of the frames'
    )
    changes = {one.title: one.changes for one in departures}
    tables = {'departures': Table.of(rows, title=title)}
    return make_report(tables, scores, config, changes=changes)


def _worst(score: MethodScore) -> Row:
    """Cells of the sequence with the lowest IoU."""
    iou, name = min((score.of(name).iou, name) for name in score.sequences)
    return [(percent('worst [%]', 'worst_iou'), iou), (Column('in', '', 'worst_sequence'), name)]


def _frames_title(frames: Sequence[Frame]) -> str:
    n = len({frame.sequence for frame in frames})
    return (
        f'{len(frames)} labelled frame{"s" * (len(frames) > 1)} of {n} sequence{"s" * (n > 1)}; '
        'IoU in the GroundGrid convention'
    )
