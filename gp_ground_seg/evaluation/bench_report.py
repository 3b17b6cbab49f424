"""A benchmark as plain data, ready for JSON."""

from __future__ import annotations

import dataclasses
import math
import statistics
from typing import Any

import numpy as np

from gp_ground_seg.evaluation.bench import CaseTimes
from gp_ground_seg.evaluation.bench_scaling import Merged, ScalingPoint
from gp_ground_seg.evaluation.environment import Environment
from gp_ground_seg.evaluation.report import changed_parameters
from gp_ground_seg.parameters.config import Config

REST = 'rest'
"""Stage that stands for what the stages leave of a frame's time."""


def bench_report(
    cases: list[CaseTimes],
    merged: Merged | None,
    scaling: dict[str, list[ScalingPoint]],
    config: Config,
    environment: Environment,
    yardstick: str | None,
    data: str,
) -> dict[str, Any]:
    """Everything of a benchmark in JSON's own types; times in ms.

    Ratios are to the yardstick on the same frame, measured right before or after: their
    median, and the 99th percentile of our times over the median of the yardstick's.

    Parameters
    ----------
    cases : list of CaseTimes
        At least one.
    merged : Merged or None
        Merged clouds, if there were any.
    scaling : dict of str to list of ScalingPoint
        Series; empty if not measured.
    config : Config
        Parameters that the cases change.
    environment : Environment
        Where it ran.
    yardstick : str or None
        Name of the peer, None without one.
    data : str
        What the frames are.
    """
    points = [len(one.frame.points) for one in cases[0].times]
    return {
        'data': data,
        'n_frames': len({(one.frame.sequence, one.frame.index) for one in cases[0].times}),
        'n_points': {'median': statistics.median(points), 'max': max(points)},
        'config_changes': changed_parameters(config),
        'environment': dataclasses.asdict(environment),
        'yardstick': yardstick,
        'yardstick_ms': _spread([t.yardstick for case in cases for t in case.times])
        if yardstick
        else None,
        'cases': [_case(case, yardstick is not None) for case in cases],
        'merged': _merged(merged) if merged is not None else None,
        'scaling': {
            series: [
                {
                    'size': point.size,
                    'ms': {mode: _ms(s) for mode, s in point.seconds.items()},
                    'ratio_to_default': {m: round(r, 4) for m, r in point.ratio.items()},
                }
                for point in found
            ]
            for series, found in scaling.items()
            if found
        },
    }


def _case(case: CaseTimes, with_yardstick: bool) -> dict[str, Any]:
    seconds = [one.seconds for one in case.times]
    names = case.times[0].stages
    # Where a mode skips a stage in some frames it is still timed: close to zero.
    stages = {name: [one.stages[name] for one in case.times] for name in names}
    stages[REST] = [one.seconds - sum(one.stages.values()) for one in case.times]
    result = {
        'name': case.case.name,
        'mode': case.fit.mode,
        'backend': case.fit.backend,
        'n_threads': case.fit.n_threads,
        'ms': _spread(seconds),
        'stages_ms': {name: _ms(statistics.median(found)) for name, found in stages.items()},
        'frames': [
            {
                'sequence': one.frame.sequence,
                'index': one.frame.index,
                'n_points': len(one.frame.points),
                'ms': _ms(one.seconds),
                'yardstick_ms': None if math.isnan(one.yardstick) else _ms(one.yardstick),
            }
            for one in case.times
        ],
    }
    if with_yardstick:
        peer = [one.yardstick for one in case.times]
        paired = [a / b for a, b in zip(seconds, peer, strict=True)]
        result['ratio'] = {
            'median': round(statistics.median(paired), 4),
            'p99': round(float(np.percentile(seconds, 99)) / statistics.median(peer), 4),
        }
    return result


def _merged(merged: Merged) -> dict[str, Any]:
    ratios = [a / b for a, b in zip(merged.seconds, merged.single_seconds, strict=True)]
    return {
        'n_clouds': len(ratios),
        'n_points': statistics.median(merged.n_points),
        'ms': _ms(statistics.median(merged.seconds)),
        'single_ms': _ms(statistics.median(merged.single_seconds)),
        'ratio_to_single': round(statistics.median(ratios), 4),
    }


def _spread(seconds: list[float]) -> dict[str, float]:
    low, median, high, p99 = np.percentile(seconds, [0, 50, 100, 99])
    return {'min': _ms(low), 'median': _ms(median), 'p99': _ms(p99), 'max': _ms(high)}


def _ms(seconds: float) -> float:
    return round(1e3 * float(seconds), 4)
