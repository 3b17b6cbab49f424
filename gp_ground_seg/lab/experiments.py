"""Variants of the method on the same scans: models, steps, pseudo-inputs, and their speed.

Each experiment is a function from scans, parameters and a runner to tables; what it compares it
sets itself, over the parameters given.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gp_ground_seg.core.backend import make_backend
from gp_ground_seg.core.errors import in_thousands
from gp_ground_seg.core.parameters.config import Config, find_preset, find_spec
from gp_ground_seg.data.semantic_kitti import Frame, read_points
from gp_ground_seg.lab.cluster import HERE, Runner
from gp_ground_seg.lab.scenes import load_scan
from gp_ground_seg.lab.scoring.evaluate import (
    PATCHWORKPP,
    KnownScan,
    Method,
    OurMethod,
    Scores,
    score_methods,
)
from gp_ground_seg.lab.scoring.peers import InterpolationMethod, PatchworkppMethod
from gp_ground_seg.lab.scoring.report import (
    SIGNED,
    Form,
    Report,
    Table,
    changed_parameters,
    frame_of,
)
from gp_ground_seg.lab.scoring.tables import (
    MEASURES,
    interval_note,
    interval_text,
    make_report,
    measured,
    time_tables,
)

if TYPE_CHECKING:
    from pandas import DataFrame

Changes = Mapping[str, Any]
"""Values of parameters, by dotted name."""

_ALL: Changes = {'learning.fixed': 'none'}
MODELS: dict[str, Changes] = {
    f'{model}, {how}': {'length_scale.model': name, 'learning.mode': mode}
    for model, name in (('constant', 'constant'), ('Z', 'line_gradient'), ('Z-L', 'latent'))
    for how, mode in (('not learned', 'fixed'), ('learned', 'every_frame'))
}
MODELS['Z-L, all learned'] = {**MODELS['Z-L, learned'], **_ALL}
"""Length-scale models, each with theta given and with sigma_f and sigma_n learned, as by default;
the last one learns all length-scales too, as the paper does."""
PAIRS = [
    *(
        (f'{ours}, {how}', f'{other}, {how}')
        for other, ours in itertools.combinations(('constant', 'Z', 'Z-L'), 2)
        for how in ('not learned', 'learned')
    ),
    ('Z-L, all learned', 'Z-L, learned'),
]
"""Models of which the differences are shown."""
SCENE, PLACES = 'road_then_rubble', (0.0, 6.0, 12.0)
"""Simulated road, and where the sensor stands on it [m]; the rubble begins at 14 to 20 m."""

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

MODES = {'every_frame': 'learning', 'fixed': 'theta fixed'}
"""Values of ``learning.mode`` that are timed, and their titles."""
N_PASSES = 3
"""How often each frame is timed."""


def score_variants(
    items: Sequence[Any],
    variants: Mapping[str, Config],
    peers: Sequence[Method] = (),
    runner: Runner = HERE,
) -> tuple[Scores, DataFrame]:
    """Run variants, then `peers`, once on every scan, alternately, each scan without a past.

    Return the scores, and the measures of each method over all scans.
    """
    ours = [OurMethod(config, name) for name, config in variants.items()]
    scores = score_methods(items, [*ours, *peers], load_scan, each_alone=True, runner=runner)
    return scores, measured(scores.scans).reset_index()


def _differences(
    scores: Scores, name: str, pairs: Sequence[tuple[str, str]], prefix: str = ''
) -> dict[str, list[Any]]:
    """Columns of the difference of a measure of each pair of methods, and of its interval."""
    measure, value = MEASURES[name], measured(scores.scans)[name]
    return {
        f'{prefix}difference': [value[a] - value[b] if a != b else None for a, b in pairs],
        f'{prefix}interval': [
            interval_text(scores, b, measure, ours=a) if a != b else None for a, b in pairs
        ],
    }


def _counted(scores: Scores) -> str:
    """Say of how many scans a table is, and in what units."""
    n_scans = len(scores.scans) // len(scores.methods)
    return (
        f'{n_scans} scans of {len(scores.sequences)} sequences; IoU [%], RMSE and median of the '
        'height under true ground [cm]'
    )


def compare_models(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Compare length-scale models and ways to learn.

    A constant length-scale, the gradients of the lines (Z), and the latent process (Z-L), and
    beside them a surface that is interpolated between lowest points; then each pair with its
    interval. On labelled frames, or on a simulated smooth road that ends in rubble, or the rough
    ground of ``--scenes``, by exact labels and heights.
    """
    variants = {name: config.replace(**changes) for name, changes in MODELS.items()}
    scores, models = score_variants(items, variants, [InterpolationMethod(config)], runner)
    learned, lines = 'Z-L, learned', scores.methods[-1]
    pairs = [pair for pair in [*PAIRS, (learned, lines)] if {*pair} <= {*scores.methods}]
    how = [[name.partition(', ')[2] for name in pair if name in MODELS] for pair in pairs]
    rows = frame_of({
        'pair': [' - '.join(name.partition(',')[0] for name in pair) for pair in pairs],
        'theta': [' - '.join(dict.fromkeys(words)) for words in how],
        **_differences(scores, 'iou', pairs, 'iou_'),
        **_differences(scores, 'rmse', pairs, 'rmse_'),
    })  # fmt: skip
    forms = {
        'iou_difference': Form('IoU', *SIGNED), 'iou_interval': Form('IoU, 95 % interval'),
        'rmse_difference': Form('RMSE', *SIGNED), 'rmse_interval': Form('RMSE, 95 % interval'),
    }  # fmt: skip
    of_pairs = (
        'Differences of IoU [%], where more is better, and of RMSE [cm], where less is; '
        f'{interval_note(scores)}'
    )
    models = models[['method', 'iou', 'rmse', 'median_absolute']]
    tables = {
        'models': Table(_counted(scores), models),
        'pairs': Table(of_pairs, rows, forms),
    }
    return make_report(tables, scores, config)


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
    steps = paper_steps()
    peers: list[Method] = [InterpolationMethod(config)]
    peers += [PatchworkppMethod()] if with_peer else []
    scores, table = score_variants(items, steps, peers, runner)
    names, last = scores.methods, [*steps][-1]
    above = [names[0], *names[: len(steps) - 1], *[last] * len(peers)]
    table = table.assign(**_differences(scores, 'iou', [*zip(names, above, strict=True)]))
    table = table[['method', 'iou', 'difference', 'interval', 'rmse']]
    title = (
        f'{_counted(scores)}; difference to the row above, below the steps to the last of them; '
        f'{interval_note(scores)}'
    )
    return make_report({'steps': Table(title, table)}, scores, config)


def compare_pseudo_inputs(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Sweep the number of pseudo-inputs: time against precision, the trade-off of Table I.

    All length-scales are learned.
    """
    variants = {
        f'{n:g}': config.replace(
            **_ALL, **{'length_scale.model': 'latent', 'latent.candidates_per_pseudo_input': n}
        )
        for n in CANDIDATES_PER_PSEUDO_INPUT
    }
    scores, table = score_variants(items, variants, runner=runner)
    n_inputs = scores.scans['n_pseudo_inputs'] / scores.scans['n_segments']
    scans = scores.scans.assign(n_inputs=n_inputs).groupby('method', sort=False, as_index=False)
    pairs = [(name, scores.methods[0]) for name in scores.methods]
    table = table[['method', 'iou', 'rmse']].assign(
        interval=_differences(scores, 'rmse', pairs)['interval'],
        n_pseudo_inputs=scans['n_inputs'].mean()['n_inputs'],
        median=scans['seconds'].median()['seconds'],
    )
    title = (
        f'{_counted(scores)}; candidates of a line for each pseudo-input; interval of the RMSE '
        f'minus that of the first row; n_L: pseudo-inputs of a segment, mean; time of a frame; '
        f'{interval_note(scores)}'
    )
    forms = {'method': Form('candidates'), 'n_pseudo_inputs': Form('n_L', '.1f')}
    return make_report({'pseudo_inputs': Table(title, table, forms)}, scores, config)


def measure_speed(
    items: Sequence[Frame], config: Config, runner: Runner = HERE, *, with_peer: bool = True
) -> Report:
    """Time each frame by stage, beside Patchwork++ on the same frame.

    With theta learned in every frame and with theta fixed, by the backend of the parameters and
    by numpy. Each method takes one thread. Reading is left out. The ratio to Patchwork++ is taken
    frame by frame, so it holds although the speed of the machine drifts. Run nothing else
    meanwhile.
    """
    numpy = {'runtime.backend': 'numpy'}
    variants: dict[str, Changes] = {title: {'learning.mode': m} for m, title in MODES.items()}
    if make_backend(config.runtime).name != 'numpy':
        variants |= {f'{title}, numpy': {**own, **numpy} for title, own in variants.items()}
    methods: list[Method] = [OurMethod(config.replace(**v), name) for name, v in variants.items()]
    if with_peer:
        methods.insert(len(MODES), PatchworkppMethod.of_sensor(config.sensor))
    scores = score_methods([*items] * N_PASSES, methods, _points_of, runner=runner)
    points = scores.scans['points']
    title = (
        f'Time per frame: {len(items)} frames, {N_PASSES} passes, reading left out; '
        f'{in_thousands(points.median())} points (median), at most {in_thousands(points.max())}'
    )
    tables = time_tables(scores, PATCHWORKPP if with_peer else '', title)
    return make_report(tables, scores, config)


def _points_of(frame: Frame) -> KnownScan:
    """Read the points alone: what is not scored leaves the caches as they are."""
    points = read_points(frame.points_path, frame.columns)
    return KnownScan(frame.sequence, frame.index, points)
