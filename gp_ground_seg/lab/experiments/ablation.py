"""Variants of the method on the same scans: models, steps, pseudo-inputs."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.core.parameters.config import Config, find_spec
from gp_ground_seg.core.parameters.presets import find_preset
from gp_ground_seg.lab.experiments.interpolation import interpolation_method
from gp_ground_seg.lab.experiments.variants import Changes, refuse_changed, score_variants
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.comparison import INTERVAL, interval_note, interval_text, mse_sums
from gp_ground_seg.lab.scoring.evaluate import Method, MethodScore
from gp_ground_seg.lab.scoring.patchworkpp import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import (
    Column,
    Report,
    Row,
    Table,
    centimetres,
    changed_parameters,
    milliseconds,
    percent,
)
from gp_ground_seg.lab.scoring.tables import make_report

_FIXED: Changes = {'learning.mode': 'fixed'}
_LEARNED: Changes = {'learning.mode': 'every_frame'}
_CONSTANT: Changes = {'length_scale.model': 'constant'}
_GRADIENT: Changes = {'length_scale.model': 'line_gradient'}
_LATENT: Changes = {'length_scale.model': 'latent', 'learning.fixed': 'none'}

MODELS: dict[str, Changes] = {
    'constant, not learned': {**_CONSTANT, **_FIXED},
    'constant, learned': {**_CONSTANT, **_LEARNED},
    'Z, not learned': {**_GRADIENT, **_FIXED},
    'Z, learned': {**_GRADIENT, **_LEARNED},
    'Z-L, not learned': {**_LATENT, **_FIXED},
    'Z-L, learned over the frame': {**_LATENT, **_LEARNED},
}
"""Length-scale models, each with theta given and learned; the last one is the paper's."""

SCENE = 'road_then_rubble'
PLACES = (0.0, 6.0, 12.0)
"""Where the sensor stands on the simulated road [m]; the rubble begins at 14 to 20 m."""


STEPS = {
    'vertical faces': ('faces.',),
    'labels by local roughness': ('label.',),
    'sloping mean': ('observation.slope_std',),
    'segments look aside': ('surface.',),
    'gate and lines of the growth': ('growth.', 'lines.'),
    'all else: bins, learning, sensor pose': ('',),
}
"""Steps from the preset ``paper`` to the defaults: beginnings of the names that change."""

CANDIDATES_PER_PSEUDO_INPUT = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
"""Candidates of a line for each pseudo-input; with the last, most lines have one."""


def compare_models(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Compare length-scale models and ways to learn.

    A constant length-scale, the gradients of the lines (Z), and the latent process (Z-L), and
    beside them a surface that is interpolated between lowest points. On labelled frames, or on a
    simulated smooth road that ends in rubble, by exact labels and heights.
    """
    refuse_changed(config, {name for changes in MODELS.values() for name in changes}, _LATENT)
    variants = {name: config.replace(**changes) for name, changes in MODELS.items()}
    scores = score_variants(items, variants, [interpolation_method(config)], runner=runner)
    last = scores[len(MODELS) - 1]
    rows: list[Row] = [
        [
            (Column('method'), score.name),
            (percent('IoU [%]', 'iou'), score.iou),
            *_worst(score),
            (centimetres('RMSE [cm]', 'rmse'), score.height.rmse),
            (INTERVAL, None if score is last else interval_text(score, last, mse_sums)),
            (centimetres('median [cm]', 'median_absolute'), score.height.median_absolute),
        ]
        for score in scores
    ]
    title = (
        f'{_counted(last)}; {_rule(last)}; RMSE and median of the height under true ground, '
        f'interval of the RMSE minus that of {last.name}; {interval_note(last)}'
    )
    return make_report({'models': Table(rows, title)}, scores, config, changes=MODELS)


def paper_steps() -> dict[str, Config]:
    """Return configurations from the paper to the defaults, by what is new in each."""
    steps = {'the paper (preset paper)': find_preset('paper').config}
    for title, beginnings in STEPS.items():
        *_, last = steps.values()
        names = [name for name in changed_parameters(last) if name.startswith(beginnings)]
        steps[f'+ {title}'] = last.replace(**{name: find_spec(name).default for name in names})
    return steps


def compare_steps(
    items: Sequence[Any], config: Config, runner: Runner = HERE, *, with_peer: bool = True
) -> Report:
    """Go from the paper's method to the defaults, one step after the other.

    Beside Patchwork++, and a surface that is interpolated between lowest points, with our labels.
    """
    if config != Config():
        raise ConfigError('steps: goes from the preset paper to the defaults, give no parameters')
    steps = paper_steps()
    peers: list[Method] = [interpolation_method(config)]
    peers += [PatchworkppMethod()] if with_peer else []
    scores = score_variants(items, steps, peers, runner=runner)
    rows: list[Row] = []
    for k, score in enumerate(scores):
        other = scores[min(max(k, 1), len(steps)) - 1]
        rows.append(
            [
                (Column('method'), score.title),
                (percent('IoU [%]', 'iou'), score.iou),
                (percent('difference', form='+.2f'), score.iou - other.iou if k else None),
                (INTERVAL, interval_text(score, other) if k else None),
                (centimetres('RMSE [cm]', 'rmse'), score.height.rmse),
            ]
        )
    title = (
        f'{_counted(scores[0])}, each by itself; difference to the row above, below the steps to '
        f'the last of them; {interval_note(scores[0])}; RMSE of the height under labelled ground'
    )
    return make_report({'steps': Table(rows, title)}, scores, config)


def compare_pseudo_inputs(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Sweep the number of pseudo-inputs: time against precision, the trade-off of Table I.

    All length-scales are learned.
    """
    refuse_changed(config, ['latent.candidates_per_pseudo_input', *_LATENT], _LATENT)
    names = {f'{n:g}': n for n in CANDIDATES_PER_PSEUDO_INPUT}
    variants = {
        name: config.replace(**_LATENT, **{'latent.candidates_per_pseudo_input': n})
        for name, n in names.items()
    }
    scores = score_variants(items, variants, runner=runner)
    most = scores[0]
    rows: list[Row] = []
    for score in scores:
        fits = [scan.fit for scan in score.scans if scan.fit is not None]
        learning = statistics.median(scan.stages['learning'] for scan in score.scans)
        n_evaluations = statistics.median(fit.n_evaluations for fit in fits)
        rows.append(
            [
                (Column('candidates', key='candidates_per_pseudo_input'), score.name),
                (Column('n_L', '.1f', 'n_pseudo_inputs'),
                 statistics.fmean(f.n_pseudo_inputs / f.n_segments for f in fits)),
                (Column('evaluations', '.0f', 'n_evaluations'), n_evaluations),
                (milliseconds('learning', 'learning'), learning),
                (milliseconds('frame', 'seconds'), score.seconds()),
                (percent('IoU [%]', 'iou'), score.iou),
                (centimetres('RMSE [cm]', 'rmse'), score.height.rmse),
                (INTERVAL, interval_text(score, most, mse_sums) if score is not most else None),
            ]
        )  # fmt: skip
    title = (
        f'{_counted(most)}; candidates of a line for each pseudo-input; n_L: pseudo-inputs of a '
        'segment, mean; medians of evaluations and times [ms]; RMSE of the height under labelled '
        f'ground, interval of it minus that of the first row; {interval_note(most)}'
    )
    return make_report({'pseudo_inputs': Table(rows, title)}, scores, config)


def _worst(score: MethodScore) -> Row:
    """Cells of the sequence with the lowest IoU, if there are several."""
    iou, name = min((score.of(name).iou, name) for name in score.sequences)
    where: Row = [
        (percent('worst [%]', 'worst_iou'), iou),
        (Column('in', '', 'worst_sequence'), name),
    ]
    return where if len(score.sequences) > 1 else []


def _counted(score: MethodScore) -> str:
    names = score.sequences
    where = names[0] if len(names) == 1 else f'{len(names)} sequences'
    return f'{len(score.scans)} scans of {where}'


def _rule(score: MethodScore) -> str:
    is_exact = 'exact' in score.scans[0].confusions
    return 'IoU by exact labels' if is_exact else 'IoU in the GroundGrid convention'
