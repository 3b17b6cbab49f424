"""What the node counts and how it judges it: plain numbers, no ROS."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from gp_ground_seg.config import DiagnosticsConfig

WINDOW = 100
"""Clouds over which rates and percentiles are taken."""


class Level(IntEnum):
    """Severity, with the values of ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Status:
    """One judged task.

    Attributes
    ----------
    task : str
        What is judged.
    level : Level
        How bad it is.
    message : str
        One line for a person.
    values : dict of str to str
        The numbers behind it, units in the keys.
    """

    task: str
    level: Level
    message: str
    values: dict[str, str]


@dataclass(frozen=True)
class InputFacts:
    """What is known of the input at the moment of a report.

    Attributes
    ----------
    topic : str
        Resolved name of the topic.
    qos : str
        Quality of service in use, in words.
    n_publishers : int
        Publishers of the topic.
    ros_time : float
        Time on the node's clock [s].
    """

    topic: str
    qos: str
    n_publishers: int
    ros_time: float


class SequenceGaps:
    """Messages of one publisher that never arrived, from the numbers it gives them.

    The middleware numbers a publisher's messages 1, 2, 3 ...: a hole is a message
    that was lost on the way, or overwritten in a full queue because the node was
    busy. How many were sent before the first one that arrived is not knowable,
    nor is anything where the middleware gives no numbers.
    """

    def __init__(self) -> None:
        self._last: int | None = None

    def reset(self) -> None:
        """Forget the last number: another publisher counts on its own."""
        self._last = None

    def note(self, number: int | None) -> int:
        """Return how many messages are missing before the one with this `number`."""
        last, self._last = self._last, number
        if last is None or number is None or number <= last:
            return 0
        return number - last - 1


class InputStatistics:
    """Arrivals and refusals.

    Parameters
    ----------
    now : float
        Time on a steady clock [s], as in the methods.
    """

    def __init__(self, now: float) -> None:
        self._last_arrival = now
        self._arrivals: deque[float] = deque(maxlen=WINDOW)
        self._n_received = 0
        self._n_refused = 0
        # Clouds of the newest reporting period that had any: (received, refused).
        self._recent = (0, 0)
        self._reported = True
        self._frame = ''
        self._fields = ''
        self._stamp: float | None = None
        self._last_error = ''

    def arrived(self, now: float, stamp: float, frame: str, fields: Iterable[str]) -> None:
        """Count a cloud; `stamp` is the time in its header [s]."""
        if self._reported:
            self._recent, self._reported = (0, 0), False
        self._recent = (self._recent[0] + 1, self._recent[1])
        self._n_received += 1
        self._last_arrival = now
        self._arrivals.append(now)
        self._stamp, self._frame, self._fields = stamp, frame, ' '.join(fields)

    def refused(self, reason: str) -> None:
        """Count the cloud that arrived last as one that could not be processed."""
        self._recent = (self._recent[0], self._recent[1] + 1)
        self._n_refused += 1
        self._last_error = reason

    def report(self, now: float, facts: InputFacts, limits: DiagnosticsConfig) -> Status:
        """Judge the time since the last report."""
        self._reported = True
        level, message = self._judge(now, facts, limits)
        span = self._arrivals[-1] - self._arrivals[0] if self._arrivals else 0.0
        rate = (len(self._arrivals) - 1) / span if span > 0.0 else None
        age = None if self._stamp is None else facts.ros_time - self._stamp
        values = {
            'Topic': facts.topic,
            'Publishers': str(facts.n_publishers),
            'QoS': facts.qos,
            'Events since startup': str(self._n_received),
            'Events in window': str(len(self._arrivals)),
            'Duration of window (s)': f'{span:.3f}',
            'Actual frequency (Hz)': _number(rate, '.2f'),
            'Time since last cloud (s)': f'{now - self._last_arrival:.3f}',
            'Age of last stamp (s)': _number(age, '.3f'),
            'Frame': self._frame,
            'Fields': self._fields,
            'Refused since startup': str(self._n_refused),
            'Last error': self._last_error,
        }
        return Status('input', level, message, values)

    def _judge(
        self, now: float, facts: InputFacts, limits: DiagnosticsConfig
    ) -> tuple[Level, str]:
        silence = now - self._last_arrival
        if silence > limits.stale_after:
            source = f'publishers: {facts.n_publishers}' if facts.n_publishers else 'nobody sends'
            return Level.STALE, f'no cloud on {facts.topic} for {silence:.1f} s ({source})'
        n_received, n_refused = self._recent
        if n_received == 0:
            return Level.OK, f'waiting for the first cloud on {facts.topic}'
        if n_refused == n_received:
            return Level.ERROR, f'every cloud refused: {self._last_error}'
        if n_refused > 0:
            return Level.WARN, f'{n_refused} of {n_received} clouds refused: {self._last_error}'
        return Level.OK, 'receiving'


class ProcessingStatistics:
    """Latencies and losses."""

    def __init__(self) -> None:
        self._latencies: deque[float] = deque(maxlen=WINDOW)
        self._stages: deque[Mapping[str, float]] = deque(maxlen=WINDOW)
        self._n_processed = 0
        self._n_dropped = 0
        self._recently_dropped = 0
        self._backend = ''
        self._n_threads = 0

    def processed(
        self, latency: float, stages: Mapping[str, float], backend: str, n_threads: int
    ) -> None:
        """Count a cloud that was published [s after its arrival], and its stage times [s]."""
        self._n_processed += 1
        self._latencies.append(latency)
        self._stages.append(stages)
        self._backend, self._n_threads = backend, n_threads

    def dropped(self, n_clouds: int) -> None:
        """Count clouds that were sent and never arrived here."""
        self._n_dropped += n_clouds
        self._recently_dropped += n_clouds

    def report(self, limits: DiagnosticsConfig) -> Status:
        """Judge the latest clouds, and the losses since the last report."""
        level, message = self._judge(limits)
        self._recently_dropped = 0
        values = {
            'Clouds since startup': str(self._n_processed),
            'Clouds in window': str(len(self._latencies)),
            'Dropped since startup': str(self._n_dropped),
            **_percentiles('Latency', self._latencies),
        }
        for stage in self._stages[-1] if self._stages else ():
            times = [stages[stage] for stages in self._stages if stage in stages]
            values.update(_percentiles(f'Stage {stage}', times))
        values['Backend'] = self._backend
        values['Threads'] = str(self._n_threads)
        return Status('processing', level, message, values)

    def _judge(self, limits: DiagnosticsConfig) -> tuple[Level, str]:
        if not self._latencies:
            return Level.OK, 'no cloud processed yet'
        median = float(np.median(self._latencies))
        if median > limits.max_latency:
            return Level.WARN, (
                f'too slow: median latency {1e3 * median:.0f} ms, '
                f'above {1e3 * limits.max_latency:g} ms'
            )
        if self._recently_dropped:
            return Level.WARN, f'{self._recently_dropped} clouds dropped since the last report'
        return Level.OK, f'median latency {1e3 * median:.1f} ms'


def _percentiles(name: str, seconds: Iterable[float]) -> dict[str, str]:
    times = 1e3 * np.array(list(seconds))
    if not len(times):
        return {}
    return {f'{name} p{q} (ms)': f'{np.percentile(times, q):.2f}' for q in (50, 95, 99)}


def _number(value: float | None, form: str) -> str:
    return 'unknown' if value is None else format(value, form)
