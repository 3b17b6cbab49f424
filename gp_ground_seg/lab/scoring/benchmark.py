"""Time per frame by stage, alternately with a baseline."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import FitReport
from gp_ground_seg.lab.scale.cluster import Progress
from gp_ground_seg.lab.scoring.evaluate import Method, OurMethod
from gp_ground_seg.lab.scoring.report import changed_parameters

MODES = {'fixed': 'theta fixed', 'every_frame': 'learning'}
"""Values of ``learning.mode`` that are timed, and their titles."""


@dataclass(frozen=True)
class BenchFrame:
    """A cloud in memory, (N, 4) x, y, z [m] and intensity."""

    sequence: str
    index: str
    points: npt.NDArray[np.float32]


class FrameTime(NamedTuple):
    """Seconds of one frame, by stage, and of the baseline on it (NaN without one)."""

    frame: BenchFrame
    seconds: float
    stages: dict[str, float]
    baseline: float
    fit: FitReport

    @property
    def ratio(self) -> float:
        """Time over that of the baseline."""
        return self.seconds / self.baseline


def bench_cases(config: Config, threads: Sequence[int], *, with_numpy: bool) -> dict[str, Config]:
    """Theta fixed and learned in every frame, on each number of threads; learning with numpy."""
    cases = {
        f'{title}, {n} thread{"s" if n > 1 else ""}': config.replace(
            **{'learning.mode': mode, 'runtime.n_threads': n}
        )
        for mode, title in MODES.items()
        for n in threads
    }
    if with_numpy:
        changes = {'learning.mode': 'every_frame', 'runtime.backend': 'numpy'}
        cases['learning, numpy'] = config.replace(**changes)
    return cases


def run_cases(
    frames: Sequence[BenchFrame],
    cases: Mapping[str, Config],
    make_baseline: Callable[[], Method] | None = None,
    n_passes: int = 1,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress = iter,
) -> dict[str, list[FrameTime]]:
    """Time every case on every frame, each time beside the baseline on that frame.

    The speed of a machine drifts over seconds; a case and its baseline follow one another, so
    that their ratio does not. Which of the two goes first, and which case is the first, changes
    from frame to frame. Each runs once without counting. `frames` are grouped by sequence;
    `make_baseline` makes the baseline of each case.
    """
    names = list(cases)
    with ExitStack() as stack:
        pairs: list[tuple[OurMethod, Method | None]] = []
        for config in cases.values():
            ours = stack.enter_context(closing(OurMethod(config)))
            baseline = make_baseline() if make_baseline else None
            pairs.append((ours, baseline))
            for method in (ours, ours, baseline):
                _time(method, frames[0], clock)
        times: dict[str, list[FrameTime]] = {name: [] for name in names}
        sequence = None
        for k, frame in enumerate(progress([*frames] * n_passes)):
            for j in range(k, k + len(names)):
                ours, baseline = pairs[j % len(names)]
                order = (baseline, ours) if k // len(names) % 2 == 0 else (ours, baseline)
                for method in order:
                    if method is not None and frame.sequence != sequence:
                        method.reset()
                seconds = {method: _time(method, frame, clock) for method in order}
                found = FrameTime(
                    frame, seconds[ours], ours.stages, seconds[baseline], ours.last.fit
                )
                times[names[j % len(names)]].append(found)
            sequence = frame.sequence
    return times


def _time(method: Method | None, frame: BenchFrame, clock: Callable[[], float]) -> float:
    if method is None:
        return math.nan
    start = clock()
    method.run(frame.points)
    return clock() - start


def bench_document(
    cases: Mapping[str, Sequence[FrameTime]],
    config: Config,
    environment: dict[str, Any],
    baseline: str | None,
    data: str,
) -> dict[str, Any]:
    """Everything of a benchmark in JSON's types; times in ms.

    Ratios are to the baseline on the same frame; p99 is that of our times over the median of the
    baseline.
    """
    times = next(iter(cases.values()))
    points = [len(entry.frame.points) for entry in times]
    peer = [entry.baseline for case in cases.values() for entry in case]
    return {
        'data': data,
        'n_frames': len({(entry.frame.sequence, entry.frame.index) for entry in times}),
        'n_points': {'median': statistics.median(points), 'max': max(points)},
        'config_changes': changed_parameters(config),
        'environment': environment,
        'baseline': baseline,
        'baseline_ms': _spread(peer) if baseline else None,
        'cases': [_case(name, case, baseline is not None) for name, case in cases.items()],
    }


def _case(name: str, times: Sequence[FrameTime], with_baseline: bool) -> dict[str, Any]:
    # Where a mode skips a stage in some frames it is still timed: close to zero.
    stages = {stage: [entry.stages[stage] for entry in times] for stage in times[0].stages}
    stages['rest'] = [entry.seconds - sum(entry.stages.values()) for entry in times]
    seconds, last = [entry.seconds for entry in times], times[-1].fit
    result = {
        'name': name,
        'mode': last.mode,
        'backend': last.backend,
        'n_threads': last.n_threads,
        'ms': _spread(seconds),
        'stages_ms': {stage: _ms(statistics.median(values)) for stage, values in stages.items()},
        'frames': [
            {
                'sequence': entry.frame.sequence,
                'index': entry.frame.index,
                'n_points': len(entry.frame.points),
                'ms': _ms(entry.seconds),
                'baseline_ms': _ms(entry.baseline) if with_baseline else None,
            }
            for entry in times
        ],
    }
    if with_baseline:
        median = statistics.median(entry.baseline for entry in times)
        result['ratio'] = {
            'median': round(statistics.median(entry.ratio for entry in times), 4),
            'p99': round(float(np.percentile(seconds, 99)) / median, 4),
        }
    return result


def _spread(seconds: Sequence[float]) -> dict[str, float]:
    low, median, high, p99 = np.percentile(seconds, [0, 50, 100, 99])
    return {'min': _ms(low), 'median': _ms(median), 'p99': _ms(p99), 'max': _ms(high)}


def _ms(seconds: float) -> float:
    return round(1e3 * float(seconds), 4)
