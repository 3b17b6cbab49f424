"""Time per frame by stage, alternately with a baseline, and its growth with the problem."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Sequence
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

REST = 'rest'
"""Stage that stands for what the stages leave of the time of a frame."""
MODES = {'fixed': 'theta fixed', 'every_frame': 'learning'}
"""Values of ``learning.mode`` that are timed, and their titles."""
N_MERGED = 4
"""Largest number of successive frames that are merged to one cloud."""
N_GROWTH_FRAMES, N_GROWTH_RUNS = 6, 3


@dataclass(frozen=True)
class BenchFrame:
    """A cloud in memory.

    Attributes
    ----------
    sequence, index : str
        Where it is from; what is temporal starts anew with each sequence.
    points : (N, 4) float32
        x, y, z [m] and intensity.
    baseline_points : (M, 4) float32 or None
        Points that the baseline runs on, if others.
    """

    sequence: str
    index: str
    points: Points
    baseline_points: Points | None = None


class BenchCase(NamedTuple):
    """A way to run the segmentation: a title, such as ``learning, 1 thread``, and parameters."""

    name: str
    config: Config


class FrameTime(NamedTuple):
    """Seconds of one frame, by stage, and of the baseline on it (NaN without one)."""

    frame: BenchFrame
    seconds: float
    stages: dict[str, float]
    baseline: float
    fit: FitReport


class CaseTimes(NamedTuple):
    """The measurements of one case, in the order of the frames."""

    case: BenchCase
    times: list[FrameTime]

    @property
    def seconds(self) -> list[float]:
        """Seconds by frame."""
        return [one.seconds for one in self.times]

    @property
    def ratios(self) -> list[float]:
        """Time over that of the baseline by frame."""
        return [one.seconds / one.baseline for one in self.times]


class Growth(NamedTuple):
    """A size of the problem: parameters changed, or a share of the points of a frame.

    A share above 1 is so many successive frames laid over one another, unregistered.
    """

    series: str
    changes: dict[str, ParameterValue]
    share: float = 1.0


def bench_cases(config: Config, threads: Sequence[int], *, with_numpy: bool) -> list[BenchCase]:
    """Theta fixed and learned in every frame, on each number of threads; learning with numpy."""
    cases = []
    for mode, title in MODES.items():
        for n in threads:
            name = f'{title}, {n} thread{"s" if n > 1 else ""}'
            changes = {'learning.mode': mode, 'runtime.n_threads': n}
            cases.append(BenchCase(name, config.replace(**changes)))
    if with_numpy:
        changes = {'learning.mode': 'every_frame', 'runtime.backend': 'numpy'}
        cases.append(BenchCase('learning, numpy', config.replace(**changes)))
    return cases


def run_cases(
    frames: Sequence[BenchFrame],
    cases: Sequence[BenchCase],
    make_baseline: Callable[[BenchCase], Method] | None = None,
    n_passes: int = 1,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress = iter,
) -> list[CaseTimes]:
    """Time every case on every frame, each time beside the baseline on that frame.

    The speed of a machine drifts over seconds; a case and its baseline follow one
    another, so that their ratio does not. Which of the two goes first, and which case
    is the first, changes from frame to frame. Before the first frame counts, each has
    run on it: compilation and first allocations are not its speed.

    Parameters
    ----------
    frames : sequence of BenchFrame
        At least one, grouped by sequence.
    cases : sequence of BenchCase
        What to time.
    make_baseline : callable, optional
        Makes the baseline of a case, which sees every frame as often as the case does.
    n_passes : int
        How often to go over the frames.
    clock, progress : callable
        Source of seconds; wraps the frames, as tqdm does.
    """
    with ExitStack() as stack:
        pairs: list[tuple[OurMethod, Method | None]] = []
        for case in cases:
            ours = stack.enter_context(closing(OurMethod(case.config)))
            baseline = make_baseline(case) if make_baseline is not None else None
            if baseline is not None:
                stack.enter_context(closing(baseline))
            pairs.append((ours, baseline))
            for method in (ours, ours, baseline):  # does not count
                _time(method, frames[0], clock, method is baseline)
        times: list[list[FrameTime]] = [[] for _ in cases]
        sequence = None
        for k, frame in enumerate(progress([*frames] * n_passes)):
            for j in range(k, k + len(cases)):
                ours, baseline = pairs[j % len(cases)]
                if frame.sequence != sequence:
                    for method in (ours, baseline):
                        if method is not None:
                            method.reset()
                if goes_first := k // len(cases) % 2 == 0:
                    other = _time(baseline, frame, clock, True)
                seconds = _time(ours, frame, clock, False)
                if not goes_first:
                    other = _time(baseline, frame, clock, True)
                result = ours.result()
                assert result.fit is not None
                times[j % len(cases)].append(
                    FrameTime(frame, seconds, result.stages, other, result.fit)
                )
            sequence = frame.sequence
    return [CaseTimes(case, found) for case, found in zip(cases, times, strict=True)]


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

    Up to six groups of successive frames are used, spread evenly; sizes that need more
    frames than there are are left out.

    Returns
    -------
    list of dict
        For each size its series and size, and by mode the median time [ms] and the median
        ratio to the time of the frame as it is.
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
            dataclasses.replace(
                group[0], points=_share_of(group, size.share), baseline_points=group[0].points
            )
            for group in chosen
        ]
        cases = [BenchCase(mode, one.replace(**size.changes)) for mode, one in given.items()]
        found = run_cases(
            clouds, cases, lambda case: OurMethod(given[case.name]), N_GROWTH_RUNS, clock
        )
        counts = {
            'points': statistics.median(len(cloud.points) for cloud in clouds),
            'pseudo-inputs': statistics.median(t.fit.n_pseudo_inputs for t in found[0].times),
            **size.changes,
        }
        row: dict[str, Any] = {'series': size.series, 'size': counts[size.series]}
        for mode, one in zip(MODES, found, strict=True):
            row[f'{mode}_ms'] = _ms(statistics.median(one.seconds))
            row[f'{mode}_ratio'] = round(statistics.median(one.ratios), 4)
        rows.append(row)
    return rows


def _share_of(group: Sequence[BenchFrame], share: float) -> Points:
    """So many times the points of the first frame, by random rows or further frames."""
    if share >= 1.0:
        return np.concatenate([frame.points for frame in group[: round(share)]])
    points = group[0].points
    rows = np.random.default_rng(0).permutation(len(points))[: round(share * len(points))]
    return points[np.sort(rows)]


def bench_document(
    cases: Sequence[CaseTimes],
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
    times = cases[0].times
    points = [len(one.frame.points) for one in times]
    peer = [one.baseline for case in cases for one in case.times]
    return {
        'data': data,
        'n_frames': len({(one.frame.sequence, one.frame.index) for one in times}),
        'n_points': {'median': statistics.median(points), 'max': max(points)},
        'config_changes': changed_parameters(config),
        'environment': dataclasses.asdict(environment),
        'baseline': baseline,
        'baseline_ms': _spread(peer) if baseline else None,
        'cases': [_case(case, baseline is not None) for case in cases],
        'growth': growth,
    }


def _case(case: CaseTimes, with_baseline: bool) -> dict[str, Any]:
    # Where a mode skips a stage in some frames it is still timed: close to zero.
    stages = {name: [one.stages[name] for one in case.times] for name in case.times[0].stages}
    stages[REST] = [one.seconds - sum(one.stages.values()) for one in case.times]
    last = case.times[-1].fit
    result = {
        'name': case.case.name,
        'mode': last.mode,
        'backend': last.backend,
        'n_threads': last.n_threads,
        'ms': _spread(case.seconds),
        'stages_ms': {name: _ms(statistics.median(found)) for name, found in stages.items()},
        'frames': [
            {
                'sequence': one.frame.sequence,
                'index': one.frame.index,
                'n_points': len(one.frame.points),
                'ms': _ms(one.seconds),
                'baseline_ms': _ms(one.baseline) if with_baseline else None,
            }
            for one in case.times
        ],
    }
    if with_baseline:
        median = statistics.median(one.baseline for one in case.times)
        result['ratio'] = {
            'median': round(statistics.median(case.ratios), 4),
            'p99': round(float(np.percentile(case.seconds, 99)) / median, 4),
        }
    return result


def _spread(seconds: Sequence[float]) -> dict[str, float]:
    low, median, high, p99 = np.percentile(seconds, [0, 50, 100, 99])
    return {'min': _ms(low), 'median': _ms(median), 'p99': _ms(p99), 'max': _ms(high)}


def _ms(seconds: float) -> float:
    return round(1e3 * float(seconds), 4)
