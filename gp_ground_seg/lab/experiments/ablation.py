"""What settings are worth: length-scale models, departures from the paper."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any, NamedTuple

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.lab.experiments.interpolation import interpolation_method
from gp_ground_seg.lab.experiments.variants import (
    Changes,
    make_report,
    refuse_changed,
    scene_parts,
    score_variants,
)
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring import report
from gp_ground_seg.lab.scoring.evaluate import KnownScan, MethodScore, load_kitti
from gp_ground_seg.lab.scoring.intervals import INTERVAL, interval_note, interval_text, mse_sums
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, percent

_FIXED: Changes = {'learning.mode': 'fixed'}
_WHOLE_FRAME: Changes = {'learning.mode': 'every_frame', 'learning.scope': 'frame'}
_CONSTANT: Changes = {'length_scale.model': 'constant'}
_GRADIENT: Changes = {'length_scale.model': 'line_gradient'}
_LATENT: Changes = {'length_scale.model': 'latent', 'learning.fixed': 'none'}

MODELS: dict[str, Changes] = {
    'constant, not learned': {**_CONSTANT, **_FIXED},
    'constant, learned': {**_CONSTANT, **_WHOLE_FRAME},
    'Z, not learned': {**_GRADIENT, **_FIXED},
    'Z, learned': {**_GRADIENT, **_WHOLE_FRAME},
    'Z-L, not learned': {**_LATENT, **_FIXED},
    'Z-L, learned over the frame': {**_LATENT, **_WHOLE_FRAME},
}
"""Length-scale models, each with theta given and learned; the last one is the paper's."""

SCENE = 'road_then_rubble'
PLACES = (0.0, 6.0, 12.0)
"""Where the sensor stands on the simulated road [m]; the rubble begins at 14 to 20 m."""


class Departure(NamedTuple):
    """A departure from the paper, or another choice."""

    title: str
    changes: Changes  # switch it off; where it is not kept, on
    kept: bool = True  # if the defaults have it


_PLAIN_BAND: Changes = {'label.rule': 'tolerance', 'label.ground_tolerance': 0.2}

DEPARTURES: tuple[Departure, ...] = (
    Departure('latent length-scales (constant instead)', {'length_scale.model': 'constant'}),
    Departure('learning in every frame', {'learning.mode': 'fixed'}),
    Departure('objective without the latent terms', {'learning.objective': 'paper'}),
    Departure('sloping mean', {'observation.slope_std': 0.0}),
    Departure('segments look aside', {'surface.look_aside': False}),
    Departure('asymmetric gate of the growth', {'growth.max_standardised_depth': 2.0}),
    Departure('vertical faces', {'faces.max_normal_z': 0.0}),
    Departure('vertical faces with occluded base', {'faces.max_foot_distance': 0.0}),
    Departure('labels by the predictive distribution', _PLAIN_BAND),
    Departure('bins that widen, 80 of them', {'grid.n_bins': 120, 'grid.bin_growth': 1.0}),
    Departure('lines end at 0.1 rad', {'lines.slope_tolerance': 0.02}),
    Departure('length-scales not learned', {'learning.fixed': 'none'}),
    Departure('lines continued outside the gate', {'growth.max_line_slope': 0.0}),
    Departure('lines continued past a slope break', {'growth.min_bend_extent': 1000.0}),
    Departure('learning from every 30th segment', {'learning.segment_step': 1}),
    Departure('one theta for the frame', {'learning.scope': 'segment'}),
    Departure('240 segments', {'grid.n_segments': 240}, kept=False),
    Departure('a wider gate (3)', {'growth.max_standardised_residual': 3.0}, kept=False),
    Departure('obstacles from 0.3 m on', {'label.obstacle_min_height': 0.3}, kept=False),
)
"""What `departures` measures. A new row here is all that a further one takes."""


def compare_models(
    items: Sequence[Any],
    load: Callable[[Any], KnownScan],
    config: Config,
    runner: Runner = HERE,
) -> Report:
    """Score `MODELS` and an interpolation; ConfigError if `config` sets what they set."""
    refuse_changed(config, {name for changes in MODELS.values() for name in changes})
    variants = {name: config.replace(**changes) for name, changes in MODELS.items()}
    with closing(interpolation_method(config)) as plain:
        scores = score_variants(items, load, variants, [plain], runner=runner)
    last = scores[len(MODELS) - 1]
    # Simulated scans are of one sequence, and of many scenes.
    parts = MethodScore.parts if len(last.sequences) > 1 else scene_parts
    rows: list[Row] = [
        [
            (Column('method'), one.name),
            (percent('IoU [%]', 'iou'), one.iou),
            *_worst_and_rmse(one),
            (INTERVAL, None if one is last else interval_text(parts(one), parts(last), mse_sums)),
            (report.centimetres('median [cm]', 'median_absolute'), one.height.median_absolute),
        ]
        for one in scores
    ]
    clusters = 'sequences' if len(last.sequences) > 1 else 'scenes'
    title = (
        f'{_counted(last)}; RMSE and median of the height under true ground, RMSE minus that of '
        f'{last.name}: {interval_note(f"{len(parts(last))} {clusters}")}'
    )
    return make_report({'models': Table.of(rows, title=title)}, scores, config, changes=MODELS)


def compare_departures(frames: Sequence[Frame], config: Config, runner: Runner = HERE) -> Report:
    """Switch one departure after the other, on the same frames in the same run."""
    variants = {'as given': config}
    for one in DEPARTURES:
        variants[one.title] = config.replace(**one.changes)
        if variants[one.title] == config:
            raise ConfigError(f'departure {one.title!r}: its switch changes nothing')
    scores = score_variants(frames, load_kitti, variants, runner=runner)
    given, *switched = scores

    def row(
        score: MethodScore,
        switch: str | None = None,
        worth: float | None = None,
        interval: str | None = None,
    ) -> Row:
        pairs = zip(score.scans, given.scans, strict=True)
        time_ratio = statistics.median(one.seconds / other.seconds for one, other in pairs)
        return [
            (Column('departure'), score.name),
            (Column('switch'), switch),
            (percent('IoU [%]', 'iou'), score.iou),
            (percent('worth [%]', 'worth', '+.2f'), worth),
            (INTERVAL, interval),
            *_worst_and_rmse(score),
            (Column('time', '.2f', 'time_ratio'), time_ratio),
        ]

    switches = []
    for one, score in zip(DEPARTURES, switched, strict=True):
        having, without = (given, score) if one.kept else (score, given)
        interval = interval_text(having.parts(), without.parts())
        switch = 'off' if one.kept else 'on'
        switches.append((score, switch, having.iou - without.iou, interval))
    rows = [row(given), *(row(*one) for one in sorted(switches, key=lambda one: -one[2]))]
    title = (
        f'{_counted(given)}; worth: what having it adds to the IoU; '
        f'{interval_note(f"{len(given.sequences)} sequences")}; RMSE of the height; '
        'time: over that as given, median of the frames'
    )
    tables = {'departures': Table.of(rows, title=title)}
    changes = {one.title: one.changes for one in DEPARTURES}
    return make_report(tables, scores, config, changes=changes)


def _worst_and_rmse(score: MethodScore) -> Row:
    """Cells of the sequence with the lowest IoU, if there are several, and of the height error."""
    iou, name = min((score.of(name).iou, name) for name in score.sequences)
    rmse: Row = [(report.centimetres('RMSE [cm]', 'rmse'), score.height.rmse)]
    if len(score.sequences) == 1:
        return rmse
    where = (Column('in', '', 'worst_sequence'), name)
    return [(percent('worst [%]', 'worst_iou'), iou), where, *rmse]


def _counted(score: MethodScore) -> str:
    is_exact = 'exact' in score.scans[0].confusions
    rule = 'by exact labels' if is_exact else 'in the GroundGrid convention'
    return f'{len(score.scans)} scans of {", ".join(score.sequences)}; IoU {rule}'
