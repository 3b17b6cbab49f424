"""Variants of the method on the same scans: models, steps, pseudo-inputs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.core.parameters.config import Config, find_preset, find_spec
from gp_ground_seg.lab.cluster import HERE, Runner
from gp_ground_seg.lab.experiments.variants import Changes, refuse_changed, score_variants
from gp_ground_seg.lab.scoring.comparison import (
    INTERVAL,
    RMSE,
    interval_note,
    interval_text,
    iou_measure,
)
from gp_ground_seg.lab.scoring.evaluate import Method, Scores, sums, title_of
from gp_ground_seg.lab.scoring.metrics import Measure
from gp_ground_seg.lab.scoring.peers import InterpolationMethod, PatchworkppMethod
from gp_ground_seg.lab.scoring.report import (
    Column,
    Report,
    Table,
    centimetres,
    changed_parameters,
    milliseconds,
    percent,
)
from gp_ground_seg.lab.scoring.tables import make_report

if TYPE_CHECKING:
    from pandas import Series

_FIXED: Changes = {'learning.mode': 'fixed'}
_LEARNED: Changes = {'learning.mode': 'every_frame'}
_CONSTANT: Changes = {'length_scale.model': 'constant'}
_GRADIENT: Changes = {'length_scale.model': 'line_gradient'}
_LATENT: Changes = {'length_scale.model': 'latent'}
_ALL: Changes = {'learning.fixed': 'none'}

MODELS: dict[str, Changes] = {
    'constant, not learned': {**_CONSTANT, **_FIXED},
    'constant, learned': {**_CONSTANT, **_LEARNED},
    'Z, not learned': {**_GRADIENT, **_FIXED},
    'Z, learned': {**_GRADIENT, **_LEARNED},
    'Z-L, not learned': {**_LATENT, **_FIXED},
    'Z-L, learned': {**_LATENT, **_LEARNED},
    'Z-L, all learned': {**_LATENT, **_LEARNED, **_ALL},
}
"""Length-scale models, each with theta given and with sigma_f and sigma_n learned, as by default;
the last one learns all length-scales too, as the paper does."""

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
    beside them a surface that is interpolated between lowest points; then each pair with its
    interval. On labelled frames, or on a simulated smooth road that ends in rubble, or the rough
    ground of ``--scenes``, by exact labels and heights.
    """
    refuse_changed(config, {name for changes in MODELS.values() for name in changes}, _ALL)
    variants = {name: config.replace(**changes) for name, changes in MODELS.items()}
    scores = score_variants(items, variants, [InterpolationMethod(config)], runner=runner)
    pooled = sums(scores.scans)
    columns = {
        Column('method'): scores.methods,
        percent('IoU [%]', 'iou'): _iou(scores).of(pooled),
        **_worst(scores),
        centimetres('RMSE [cm]', 'rmse'): RMSE.of(pooled),
        centimetres('median [cm]', 'median_absolute'): _medians(scores),
    }
    title = f'{_counted(scores)}; {_rule(scores)}; RMSE and median of the height under true ground'
    tables = {'models': Table(columns, title), 'pairs': _pairs_table(scores)}
    return make_report(tables, scores, config, changes=MODELS)


def _pairs_table(scores: Scores) -> Table:
    """Compare Z-L, Z and a constant, each pair, and Z-L and the interpolation."""
    learned = 'Z-L, learned'
    pairs = [
        (ours, other)
        for other, ours in itertools.combinations(MODELS, 2)
        if ours.partition(', ')[2] == other.partition(', ')[2]
    ]
    pairs += [('Z-L, all learned', learned), (learned, scores.methods[-1])]
    pairs = [pair for pair in pairs if {*pair} <= {*scores.methods}]
    pooled = sums(scores.scans)
    models = [[name.partition(',')[0] for name in pair] for pair in pairs]
    columns: dict[Column, Any] = {
        Column('pair'): [' - '.join(names) for names in models],
        Column('theta'): [
            ' - '.join(dict.fromkeys(name.partition(', ')[2] for name in pair if name in MODELS))
            for pair in pairs
        ],
    }
    for column, measure in (
        (percent('IoU', 'iou', '+.2f'), _iou(scores)),
        (replace(centimetres('RMSE', 'rmse'), format='+.2f'), RMSE),
    ):
        value = measure.of(pooled)
        columns[column] = [value[ours] - value[other] for ours, other in pairs]
        columns[Column(f'{column.title}, 95 % interval', key=f'{column.key}_interval')] = [
            interval_text(scores, other, measure, ours=ours) for ours, other in pairs
        ]
    title = (
        'Differences of IoU [%], where more is better, and of RMSE [cm], where less is; '
        f'{interval_note(scores)}'
    )
    return Table(columns, title)


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
    peers: list[Method] = [InterpolationMethod(config)]
    peers += [PatchworkppMethod()] if with_peer else []
    scores = score_variants(items, steps, peers, runner=runner)
    pooled, iou = sums(scores.scans), _iou(scores)
    shares = iou.of(pooled)
    names = scores.methods
    # The row above; below the steps the last of them.
    others = [names[min(max(k, 1), len(steps)) - 1] for k in range(len(names))]
    pairs = [*zip(names, others, strict=True)][1:]
    columns = {
        Column('method'): [title_of(name) for name in names],
        percent('IoU [%]', 'iou'): shares,
        percent('difference', form='+.2f'): [None, *(shares[a] - shares[b] for a, b in pairs)],
        INTERVAL: [None, *(interval_text(scores, b, iou, ours=a) for a, b in pairs)],
        centimetres('RMSE [cm]', 'rmse'): RMSE.of(pooled),
    }
    title = (
        f'{_counted(scores)}, each by itself; difference to the row above, below the steps to '
        f'the last of them; {interval_note(scores)}; RMSE of the height under labelled ground'
    )
    return make_report({'steps': Table(columns, title)}, scores, config)


def compare_pseudo_inputs(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Sweep the number of pseudo-inputs: time against precision, the trade-off of Table I.

    All length-scales are learned.
    """
    refuse_changed(config, ['latent.candidates_per_pseudo_input', *_LATENT, *_ALL], _ALL)
    names = {f'{n:g}': n for n in CANDIDATES_PER_PSEUDO_INPUT}
    variants = {
        name: config.replace(**_LATENT, **_ALL, **{'latent.candidates_per_pseudo_input': n})
        for name, n in names.items()
    }
    scores = score_variants(items, variants, runner=runner)
    most, pooled = scores.methods[0], sums(scores.scans)
    shares = scores.scans['n_pseudo_inputs'] / scores.scans['n_segments']
    by_method = scores.scans.assign(n=shares).groupby('method', sort=False)
    columns = {
        Column('candidates', key='candidates_per_pseudo_input'): scores.methods,
        Column('n_L', '.1f', 'n_pseudo_inputs'): by_method['n'].mean(),
        Column('evaluations', '.0f', 'n_evaluations'): by_method['n_evaluations'].median(),
        milliseconds('learning', 'learning'):
            scores.times.groupby('method', sort=False)['learning'].median(),
        milliseconds('frame', 'seconds'): by_method['seconds'].median(),
        percent('IoU [%]', 'iou'): _iou(scores).of(pooled),
        centimetres('RMSE [cm]', 'rmse'): RMSE.of(pooled),
        INTERVAL: [
            interval_text(scores, most, RMSE, ours=name) if name != most else None
            for name in scores.methods
        ],
    }  # fmt: skip
    title = (
        f'{_counted(scores)}; candidates of a line for each pseudo-input; n_L: pseudo-inputs of a '
        'segment, mean; medians of evaluations and times [ms]; RMSE of the height under labelled '
        f'ground, interval of it minus that of the first row; {interval_note(scores)}'
    )
    return make_report({'pseudo_inputs': Table(columns, title)}, scores, config)


def _iou(scores: Scores) -> Measure:
    """Return the IoU in the convention that counts."""
    return iou_measure(scores.conventions[0])


def _medians(scores: Scores) -> Series:
    """Median over the scans of the median absolute error of the height [m]."""
    return scores.scans.groupby('method', sort=False)['median_absolute'].median()


def _worst(scores: Scores) -> dict[Column, Any]:
    """Columns of the sequence with the lowest IoU, if there are several."""
    if len(scores.sequences) < 2:
        return {}
    iou = _iou(scores).of(sums(scores.scans, 'sequence')).unstack('sequence')
    iou = iou.loc[scores.methods, sorted(scores.sequences)]
    return {
        percent('worst [%]', 'worst_iou'): iou.min(axis='columns'),
        Column('in', '', 'worst_sequence'): iou.idxmin(axis='columns'),
    }


def _counted(scores: Scores) -> str:
    names, n_scans = scores.sequences, sums(scores.scans)['n_scans'].iloc[0]
    where = names[0] if len(names) == 1 else f'{len(names)} sequences'
    return f'{n_scans} scans of {where}'


def _rule(scores: Scores) -> str:
    is_exact = scores.conventions == ['exact']
    return 'IoU by exact labels' if is_exact else 'IoU in the GroundGrid convention'
