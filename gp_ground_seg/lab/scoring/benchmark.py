"""Time per frame by stage, alternately with a baseline."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.evaluate import (
    KnownScan,
    Method,
    OurMethod,
    as_it_is,
    score_methods,
)
from gp_ground_seg.lab.scoring.frames import KEYS, Scores
from gp_ground_seg.lab.scoring.report import changed_parameters

if TYPE_CHECKING:
    from pandas import Series

MODES = {'fixed': 'theta fixed', 'every_frame': 'learning'}
"""Values of ``learning.mode`` that are timed, and their titles."""
BESIDE = 'baseline of '


def bench_cases(config: Config, *, with_numpy: bool) -> dict[str, Config]:
    """Theta fixed and learned in every frame, on one thread, and with numpy."""
    cases = {
        f'{title}, 1 thread': config.replace(**{'learning.mode': mode})
        for mode, title in MODES.items()
    }
    if with_numpy:
        for mode, title in MODES.items():
            changes = {'learning.mode': mode, 'runtime.backend': 'numpy'}
            cases[f'{title}, numpy'] = config.replace(**changes)
    return cases


def run_cases(
    scans: Sequence[KnownScan],
    cases: Mapping[str, Config],
    make_baseline: Callable[[], Method] | None = None,
    n_passes: int = 1,
    clock: Callable[[], float] = time.perf_counter,
    runner: Runner = HERE,
) -> Scores:
    """Time every case on every scan, each time beside a baseline of its own on that scan.

    The speed of a machine drifts over seconds; a case and its baseline follow one another, so
    that their ratio does not. Which of the two goes first changes from scan to scan, as
    `score_methods` says. `scans` are grouped by sequence. The scores have the name of each case,
    and `BESIDE` before it for its baseline if there is one.
    """
    methods: list[Method] = []
    for name, config in cases.items():
        methods.append(OurMethod(config, name))
        if make_baseline is not None:
            methods.append(make_baseline())
            methods[-1].name = f'{BESIDE}{name}'
    items = [*scans] * n_passes
    return score_methods(items, methods, as_it_is, clock=clock, runner=runner)


def bench_document(
    scores: Scores,
    config: Config,
    environment: dict[str, Any],
    baseline: str | None,
    data: str,
) -> dict[str, Any]:
    """Everything of a benchmark in JSON's types; times in ms.

    `scores` are as from `run_cases`. Ratios are to the baseline on the same scan; p99 is that of
    our times over the median of the baseline.
    """
    scans = scores.scans
    is_peer = scans['method'].str.startswith(BESIDE)
    points = scans.loc[scans['method'] == scores.methods[0], 'points']
    seconds = {name: own.to_numpy() for name, own in scans.groupby('method')['seconds']}
    return {
        'data': data,
        'n_frames': len(scans.drop_duplicates(['sequence', 'index'])),
        'n_points': {'median': float(points.median()), 'max': int(points.max())},
        'config_changes': changed_parameters(config),
        'environment': environment,
        'baseline': baseline,
        'baseline_ms': _spread(scans.loc[is_peer, 'seconds']) if baseline else None,
        'cases': [
            _case(scores.of([name]), seconds.get(f'{BESIDE}{name}'))
            for name in scores.methods
            if not name.startswith(BESIDE)
        ],
    }


def _case(scores: Scores, peer: FloatArray | None) -> dict[str, Any]:
    """Lay out the times of a case, and of the baseline beside it [s] if there is one."""
    rows, times = scores.rows['scans'], scores.times.drop(columns=[*KEYS])
    seconds = scores.scans['seconds']
    # Where a mode skips a stage in some frames it is still timed: close to zero.
    stages = times.assign(rest=seconds - times.sum(axis='columns')).median()
    result = {
        'name': rows[0]['method'],
        'mode': rows[-1]['mode'],
        'backend': rows[-1]['backend'],
        'ms': _spread(seconds),
        'stages_ms': {stage: _ms(median) for stage, median in stages.items()},
        'frames': [
            {
                'sequence': row['sequence'],
                'index': row['index'],
                'n_points': row['points'],
                'ms': _ms(row['seconds']),
                'baseline_ms': None if peer is None else _ms(peer[k]),
            }
            for k, row in enumerate(rows)
        ],
    }
    if peer is not None:
        result['ratio'] = {
            'median': round(float(np.median(seconds / peer)), 4),
            'p99': round(float(np.percentile(seconds, 99) / np.median(peer)), 4),
        }
    return result


def _spread(seconds: Series) -> dict[str, float]:
    low, median, high, p99 = np.percentile(seconds, [0, 50, 100, 99])
    return {'min': _ms(low), 'median': _ms(median), 'p99': _ms(p99), 'max': _ms(high)}


def _ms(seconds: float) -> float:
    return round(1e3 * float(seconds), 4)
