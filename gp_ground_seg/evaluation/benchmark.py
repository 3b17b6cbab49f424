"""Time per frame by stage, alternately with a baseline, and its growth with the problem."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.environment import Environment, changed_parameters
from gp_ground_seg.evaluation.evaluate import Progress
from gp_ground_seg.evaluation.methods import Method, OurMethod
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.result import FitReport

Points = npt.NDArray[np.float32]

MODES = {'fixed': 'theta fixed', 'every_frame': 'learning'}
"""Values of ``learning.mode`` that are timed, and their titles."""
N_MERGED = 4
"""Largest number of successive frames that are merged to one cloud."""
N_GROWTH_FRAMES, N_GROWTH_RUNS = 6, 3


@dataclass(frozen=True)
class BenchFrame:
    """A cloud in memory, (N, 4) x, y, z [m] and intensity.

    What is temporal starts anew with each sequence. The baseline runs on `baseline_points`
    where there are some.
    """

    sequence: str
    index: str
    points: Points
    baseline_points: Points | None = None


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


class Growth(NamedTuple):
    """Parameters changed, or a share of the points of a frame; above 1, of successive ones."""

    series: str
    changes: dict[str, ParameterValue]
    share: float = 1.0


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
    make_baseline: Callable[[str], Method] | None = None,
    n_passes: int = 1,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress = iter,
) -> dict[str, list[FrameTime]]:
    """Time every case on every frame, each time beside the baseline on that frame.

    The speed of a machine drifts over seconds; a case and its baseline follow one
    another, so that their ratio does not. Which of the two goes first, and which case
    is the first, changes from frame to frame. Before the first frame counts, each has
    run on it: compilation and first allocations are not its speed.

    Parameters
    ----------
    frames : sequence of BenchFrame
        At least one, grouped by sequence.
    cases : mapping of str to Config
        What to time, by title, such as ``learning, 1 thread``.
    make_baseline : callable, optional
        Makes the baseline of a case, which sees every frame as often as the case does.
    """
    names = list(cases)
    with ExitStack() as stack:
        pairs: list[tuple[OurMethod, Method | None]] = []
        for name in names:
            ours = stack.enter_context(closing(OurMethod(cases[name])))
            baseline = make_baseline(name) if make_baseline is not None else None
            if baseline is not None:
                stack.enter_context(closing(baseline))
            pairs.append((ours, baseline))
            for method in (ours, ours, baseline):  # does not count
                _time(method, frames[0], clock, method is baseline)
        times: dict[str, list[FrameTime]] = {name: [] for name in names}
        sequence = None
        for k, frame in enumerate(progress([*frames] * n_passes)):
            for j in range(k, k + len(names)):
                ours, baseline = pairs[j % len(names)]
                order = (baseline, ours) if k // len(names) % 2 == 0 else (ours, baseline)
                for method in order:
                    if method is not None and frame.sequence != sequence:
                        method.reset()
                seconds = [_time(method, frame, clock, method is baseline) for method in order]
                result = ours.result()
                assert result.fit is not None
                own, other = seconds[order.index(ours)], seconds[order.index(baseline)]
                found = FrameTime(frame, own, result.stages, other, result.fit)
                times[names[j % len(names)]].append(found)
            sequence = frame.sequence
    return times


def _time(
    method: Method | None, frame: BenchFrame, clock: Callable[[], float], is_baseline: bool
) -> float:
    if method is None:
        return math.nan
    points = frame.points
    if is_baseline and frame.baseline_points is not None:
        points = frame.baseline_points
    start = clock()
    method.run(points)
    return clock() - start


def spread(n_available: int, n_wanted: int) -> list[int]:
    """Return the indices of `n_wanted` items, or of all there are, spread evenly."""
    n = min(n_available, n_wanted)
    return [(2 * k + 1) * n_available // (2 * n) for k in range(n)]


def merged_groups(frames: Sequence[BenchFrame]) -> list[list[BenchFrame]]:
    """Group `N_MERGED` successive frames of a sequence each; a rest is left out."""
    groups = []
    for _, sequence in groupby(frames, key=lambda frame: frame.sequence):
        own = list(sequence)
        groups += [own[k : k + N_MERGED] for k in range(0, len(own) - N_MERGED + 1, N_MERGED)]
    return groups


def growth_sizes(config: Config) -> list[Growth]:
    """Sizes to time: factors of the parameters given, as far as they are accepted."""
    sizes = [Growth('points', {}, share) for share in (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)]
    for name in ('grid.n_segments', 'grid.n_bins'):
        given = config[name]
        assert isinstance(given, int)
        sizes += [Growth(name, {name: round(f * given)}) for f in (0.25, 0.5, 1.0, 2.0, 4.0)]
    # The most first: many candidates for each pseudo-input leave few of them.
    name = 'latent.candidates_per_pseudo_input'
    sizes += [Growth('pseudo-inputs', {name: n}) for n in (12.0, 6.0, 3.0, 1.5, 1.0)]

    def is_accepted(size: Growth) -> bool:
        try:
            config.replace(**size.changes)
        except ConfigError:
            return False
        return True

    return [size for size in sizes if is_accepted(size)]


def time_growth(
    frames: Sequence[BenchFrame],
    config: Config,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress = iter,
) -> list[dict[str, Any]]:
    """Time one size after the other, each beside one frame under `config`, on one thread.

    Up to six groups of successive frames are used, spread evenly; sizes that need more frames
    than there are are left out. A row has series and size, and by mode the median time [ms] and
    the median ratio to the time of the frame as it is.
    """
    groups = merged_groups(frames) or [[frame] for frame in frames]
    chosen = [groups[k] for k in spread(len(groups), N_GROWTH_FRAMES)]
    given = {
        mode: config.replace(**{'learning.mode': mode, 'runtime.n_threads': 1}) for mode in MODES
    }
    rows = []
    for size in progress(growth_sizes(config)):
        if size.share > min(map(len, chosen)):
            continue
        clouds = [
            BenchFrame(group[0].sequence, group[0].index, _share_of(group, size.share),
                       baseline_points=group[0].points)
            for group in chosen
        ]  # fmt: skip
        cases = {mode: one.replace(**size.changes) for mode, one in given.items()}
        found = run_cases(clouds, cases, lambda mode: OurMethod(given[mode]), N_GROWTH_RUNS, clock)
        counts = {
            'points': statistics.median(len(cloud.points) for cloud in clouds),
            'pseudo-inputs': statistics.median(t.fit.n_pseudo_inputs for t in found['fixed']),
            **size.changes,
        }
        row: dict[str, Any] = {'series': size.series, 'size': counts[size.series]}
        for mode, times in found.items():
            row[f'{mode}_ms'] = _ms(statistics.median(one.seconds for one in times))
            row[f'{mode}_ratio'] = round(statistics.median(one.ratio for one in times), 4)
        rows.append(row)
    return rows


def _share_of(group: Sequence[BenchFrame], share: float) -> Points:
    """So many times the points of the first frame, by random rows or further frames."""
    if share >= 1.0:  # unregistered
        return np.concatenate([frame.points for frame in group[: round(share)]])
    points = group[0].points
    rows = np.random.default_rng(0).permutation(len(points))[: round(share * len(points))]
    return points[np.sort(rows)]


def bench_document(
    cases: Mapping[str, Sequence[FrameTime]],
    growth: list[dict[str, Any]],
    config: Config,
    environment: Environment,
    baseline: str | None,
    data: str,
) -> dict[str, Any]:
    """Everything of a benchmark in JSON's own types; times in ms.

    Ratios are to the baseline on the same frame, measured right before or after: their
    median, and the 99th percentile of our times over the median of those of the baseline.
    """
    times = next(iter(cases.values()))
    points = [len(one.frame.points) for one in times]
    peer = [one.baseline for own in cases.values() for one in own]
    return {
        'data': data,
        'n_frames': len({(one.frame.sequence, one.frame.index) for one in times}),
        'n_points': {'median': statistics.median(points), 'max': max(points)},
        'config_changes': changed_parameters(config),
        'environment': dataclasses.asdict(environment),
        'baseline': baseline,
        'baseline_ms': _spread(peer) if baseline else None,
        'cases': [_case(name, own, baseline is not None) for name, own in cases.items()],
        'growth': growth,
    }


def _case(name: str, times: Sequence[FrameTime], with_baseline: bool) -> dict[str, Any]:
    # Where a mode skips a stage in some frames it is still timed: close to zero.
    stages = {stage: [one.stages[stage] for one in times] for stage in times[0].stages}
    stages['rest'] = [one.seconds - sum(one.stages.values()) for one in times]
    seconds, last = [one.seconds for one in times], times[-1].fit
    result = {
        'name': name,
        'mode': last.mode,
        'backend': last.backend,
        'n_threads': last.n_threads,
        'ms': _spread(seconds),
        'stages_ms': {stage: _ms(statistics.median(own)) for stage, own in stages.items()},
        'frames': [
            {
                'sequence': one.frame.sequence,
                'index': one.frame.index,
                'n_points': len(one.frame.points),
                'ms': _ms(one.seconds),
                'baseline_ms': _ms(one.baseline) if with_baseline else None,
            }
            for one in times
        ],
    }
    if with_baseline:
        median = statistics.median(one.baseline for one in times)
        result['ratio'] = {
            'median': round(statistics.median(one.ratio for one in times), 4),
            'p99': round(float(np.percentile(seconds, 99)) / median, 4),
        }
    return result


def _spread(seconds: Sequence[float]) -> dict[str, float]:
    low, median, high, p99 = np.percentile(seconds, [0, 50, 100, 99])
    return {'min': _ms(low), 'median': _ms(median), 'p99': _ms(p99), 'max': _ms(high)}


def _ms(seconds: float) -> float:
    return round(1e3 * float(seconds), 4)
