"""Time per frame by stage, alternately with a baseline."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.evaluate import (
    KnownScan,
    Method,
    MethodScore,
    OurMethod,
    as_it_is,
    score_methods,
)
from gp_ground_seg.lab.scoring.report import changed_parameters

MODES = {'fixed': 'theta fixed', 'every_frame': 'learning'}
"""Values of ``learning.mode`` that are timed, and their titles."""


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
) -> dict[str, list[MethodScore]]:
    """Time every case on every scan, each time beside a baseline of its own on that scan.

    The speed of a machine drifts over seconds; a case and its baseline follow one another, so
    that their ratio does not. Which of the two goes first changes from scan to scan, as
    `score_methods` says. `scans` are grouped by sequence. Returns the score of each case, and
    that of its baseline if there is one.
    """
    methods: list[Method] = []
    for name, config in cases.items():
        methods.append(OurMethod(config, name))
        methods += [make_baseline()] if make_baseline else []
    items = [*scans] * n_passes
    scores = score_methods(items, methods, as_it_is, clock=clock, runner=runner)
    n = len(methods) // len(cases)
    return {name: scores[n * k : n * (k + 1)] for k, name in enumerate(cases)}


def bench_document(
    cases: Mapping[str, Sequence[MethodScore]],
    config: Config,
    environment: dict[str, Any],
    baseline: str | None,
    data: str,
) -> dict[str, Any]:
    """Everything of a benchmark in JSON's types; times in ms.

    `cases` are as from `run_cases`. Ratios are to the baseline on the same scan; p99 is that of
    our times over the median of the baseline.
    """
    (ours, *_), *_ = cases.values()
    points = [scan.n_points for scan in ours.scans]
    peer = [scan.seconds for _, *others in cases.values() for one in others for scan in one.scans]
    return {
        'data': data,
        'n_frames': len({(scan.sequence, scan.index) for scan in ours.scans}),
        'n_points': {'median': statistics.median(points), 'max': max(points)},
        'config_changes': changed_parameters(config),
        'environment': environment,
        'baseline': baseline,
        'baseline_ms': _spread(peer) if peer else None,
        'cases': [_case(name, *case) for name, case in cases.items()],
    }


def _case(name: str, ours: MethodScore, baseline: MethodScore | None = None) -> dict[str, Any]:
    scans, fit = ours.scans, ours.scans[-1].fit
    assert fit is not None
    # Where a mode skips a stage in some frames it is still timed: close to zero.
    stages = {stage: [scan.stages[stage] for scan in scans] for stage in scans[0].stages}
    stages['rest'] = [scan.seconds - sum(scan.stages.values()) for scan in scans]
    seconds = [scan.seconds for scan in scans]
    peer = [scan.seconds for scan in baseline.scans] if baseline else []
    result = {
        'name': name,
        'mode': fit.mode,
        'backend': fit.backend,
        'ms': _spread(seconds),
        'stages_ms': {stage: _ms(statistics.median(values)) for stage, values in stages.items()},
        'frames': [
            {
                'sequence': scan.sequence,
                'index': scan.index,
                'n_points': scan.n_points,
                'ms': _ms(scan.seconds),
                'baseline_ms': _ms(peer[k]) if peer else None,
            }
            for k, scan in enumerate(scans)
        ],
    }
    if peer:
        ratios = [a / b for a, b in zip(seconds, peer, strict=True)]
        result['ratio'] = {
            'median': round(statistics.median(ratios), 4),
            'p99': round(float(np.percentile(seconds, 99)) / statistics.median(peer), 4),
        }
    return result


def _spread(seconds: Sequence[float]) -> dict[str, float]:
    low, median, high, p99 = np.percentile(seconds, [0, 50, 100, 99])
    return {'min': _ms(low), 'median': _ms(median), 'p99': _ms(p99), 'max': _ms(high)}


def _ms(seconds: float) -> float:
    return round(1e3 * float(seconds), 4)
