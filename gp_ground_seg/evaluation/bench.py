"""Time per frame by stage, alternately with a yardstick that anyone can run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.evaluation.methods import Method
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.result import FitReport
from gp_ground_seg.segmenter import GroundSegmenter

NO_TIME = float('nan')


@dataclass(frozen=True)
class BenchFrame:
    """A scan in memory.

    Attributes
    ----------
    sequence, index : str
        Where it is from; what is temporal starts anew with each sequence.
    points : (N, 4) float32
        x, y, z [m] and intensity.
    """

    sequence: str
    index: str
    points: npt.NDArray[np.float32]


@dataclass(frozen=True)
class BenchCase:
    """A way to run the segmentation.

    Attributes
    ----------
    name : str
        Title, such as ``fixed, 1 thread``.
    config : Config
        Its parameters.
    """

    name: str
    config: Config


@dataclass(frozen=True)
class FrameTime:
    """One measurement.

    Attributes
    ----------
    frame : BenchFrame
        What was segmented.
    seconds : float
        Time of `GroundSegmenter.segment`.
    stages : dict of str to float
        Seconds by stage.
    yardstick : float
        Seconds of the yardstick on the same frame, just before or after; NaN without one.
    """

    frame: BenchFrame
    seconds: float
    stages: dict[str, float]
    yardstick: float


@dataclass(frozen=True)
class CaseTimes:
    """The measurements of one case, frame by frame, and what its last frame reported."""

    case: BenchCase
    times: tuple[FrameTime, ...]
    fit: FitReport


def bench_cases(config: Config, threads: Sequence[int], *, with_numpy: bool) -> list[BenchCase]:
    """Cases to compare: theta fixed and learned in every frame, on each number of threads.

    Parameters
    ----------
    config : Config
        All other parameters.
    threads : sequence of int
        Numbers of threads.
    with_numpy : bool
        Whether learning without compiled code is a case, too.
    """
    cases = []
    for mode, title in (('fixed', 'theta fixed'), ('every_frame', 'learning')):
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
    make_yardstick: Callable[[], Method] | None = None,
    n_passes: int = 1,
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[Sequence[BenchFrame]], Iterable[BenchFrame]] = iter,
) -> list[CaseTimes]:
    """Time every case on every frame, each time beside the yardstick on that frame.

    The speed of a machine drifts over seconds; a case and its yardstick follow one
    another, so that their ratio does not. Which of the two goes first, and which case
    is the first, changes from frame to frame. Before the first frame counts, each has
    run on it: compiling and first allocations are not its speed.

    Parameters
    ----------
    frames : sequence of BenchFrame
        At least one, grouped by sequence.
    cases : sequence of BenchCase
        What to time.
    make_yardstick : callable, optional
        Makes a peer; each case has its own, which sees every frame as often as it does.
    n_passes : int
        How often to go over the frames.
    clock : callable
        Source of seconds.
    progress : callable
        Wraps the frames to show how far it is, as tqdm does.

    Returns
    -------
    list of CaseTimes
        In the order of `cases`.
    """
    with ExitStack() as stack:
        runners = []
        for case in cases:
            segmenter = stack.enter_context(closing(GroundSegmenter(case.config)))
            peer = make_yardstick() if make_yardstick is not None else None
            runners.append(_Runner(case, segmenter, peer, clock))
        for runner in runners:
            runner.warm_up(frames[0])
        ordered = [frame for _ in range(n_passes) for frame in frames]
        for k, frame in enumerate(progress(ordered)):
            first = k % len(runners)
            for runner in runners[first:] + runners[:first]:
                runner.measure(frame, yardstick_first=k // len(runners) % 2 == 0)
        return [runner.result() for runner in runners]


class _Runner:
    """A case and its yardstick."""

    def __init__(
        self,
        case: BenchCase,
        segmenter: GroundSegmenter,
        yardstick: Method | None,
        clock: Callable[[], float],
    ) -> None:
        self._case = case
        self._segmenter = segmenter
        self._yardstick = yardstick
        self._clock = clock
        self._sequence: str | None = None
        self._times: list[FrameTime] = []

    def warm_up(self, frame: BenchFrame) -> None:
        """Run both on a frame that does not count."""
        for _ in range(2):
            self._fit = self._segmenter.segment(frame.points).fit
        if self._yardstick is not None:
            self._yardstick.start_sequence()
            self._yardstick.run(frame.points)

    def measure(self, frame: BenchFrame, *, yardstick_first: bool) -> None:
        """Time both on one frame."""
        if frame.sequence != self._sequence:
            self._sequence = frame.sequence
            self._segmenter.reset()
            if self._yardstick is not None:
                self._yardstick.start_sequence()
        peer = self._time_yardstick(frame) if yardstick_first else NO_TIME
        start = self._clock()
        result = self._segmenter.segment(frame.points)
        seconds = self._clock() - start
        if not yardstick_first:
            peer = self._time_yardstick(frame)
        stages = {name: value for name, value in result.timings.items() if name != 'total'}
        self._times.append(FrameTime(frame, seconds, stages, peer))
        self._fit = result.fit

    def _time_yardstick(self, frame: BenchFrame) -> float:
        if self._yardstick is None:
            return NO_TIME
        start = self._clock()
        self._yardstick.run(frame.points)
        return self._clock() - start

    def result(self) -> CaseTimes:
        """All that was measured."""
        return CaseTimes(self._case, tuple(self._times), self._fit)
