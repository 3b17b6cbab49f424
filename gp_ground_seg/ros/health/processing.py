"""How long the work takes, and what is lost because of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from gp_ground_seg.parameters.config import DiagnosticsConfig
from gp_ground_seg.ros.health.rate import Rate
from gp_ground_seg.ros.health.status import Level, Status, percentiles

TASK = 'processing'
WINDOW = 100
"""Clouds over which percentiles are taken."""
SHORTEST_SPAN = 1.0
"""Time over which the rate of the input means something [s]: a burst is no rate."""


class ProcessingStatistics:
    """Latencies, load and losses."""

    def __init__(self) -> None:
        self._latencies: deque[float] = deque(maxlen=WINDOW)
        self._durations: deque[float] = deque(maxlen=WINDOW)
        self._stages: deque[Mapping[str, float]] = deque(maxlen=WINDOW)
        self._sent = Rate()
        self._n_processed = 0
        self._n_dropped = 0
        self._n_sent_recently = 0
        self._n_dropped_recently = 0
        self._backend = ''
        self._n_threads = 0

    def arrived(self, now: float, n_lost: int) -> None:
        """Count a cloud that arrived, and those sent just before it that never did."""
        self._sent.count(now, 1 + n_lost)
        self._n_sent_recently += 1 + n_lost
        self._n_dropped += n_lost
        self._n_dropped_recently += n_lost

    def processed(
        self,
        latency: float,
        duration: float,
        stages: Mapping[str, float],
        backend: str,
        n_threads: int,
    ) -> None:
        """Count a cloud that was published.

        Parameters
        ----------
        latency : float
            Time since its arrival in this process [s].
        duration : float
            The part of it that was work, not waiting [s].
        stages : mapping
            Times of the steps [s].
        backend : str
            What computed it.
        n_threads : int
            In how many threads.
        """
        self._n_processed += 1
        self._latencies.append(latency)
        self._durations.append(duration)
        self._stages.append(stages)
        self._backend, self._n_threads = backend, n_threads

    def load(self, now: float) -> float | None:
        """Time the clouds sent in a second take to process [s/s]; None where unknown."""
        rate = self._sent.per_second(now)
        if rate is None or not self._durations or self._sent.span(now) < SHORTEST_SPAN:
            return None
        return rate * float(np.median(self._durations))

    def report(self, now: float, limits: DiagnosticsConfig) -> Status:
        """Judge the latest clouds, and the losses since the last report."""
        level, message = self._judge(now, limits)
        self._n_sent_recently = self._n_dropped_recently = 0
        load = self.load(now)
        values = {
            'Clouds since startup': str(self._n_processed),
            'Clouds in window': str(len(self._latencies)),
            'Dropped since startup': str(self._n_dropped),
            'Load (%)': 'unknown' if load is None else f'{100.0 * load:.1f}',
            **percentiles('Latency', self._latencies),
        }
        for stage in self._stages[-1] if self._stages else ():
            times = [stages[stage] for stages in self._stages if stage in stages]
            values.update(percentiles(f'Stage {stage}', times))
        values['Backend'] = self._backend
        values['Threads'] = str(self._n_threads)
        return Status(TASK, level, message, values)

    def _judge(self, now: float, limits: DiagnosticsConfig) -> tuple[Level, str]:
        if not self._latencies:
            return Level.OK, 'no cloud processed yet'
        latency = 1e3 * float(np.median(self._latencies))
        duration = 1e3 * float(np.median(self._durations))
        max_latency = 1e3 * limits.max_latency
        load = self.load(now)
        n_dropped, n_sent = self._n_dropped_recently, self._n_sent_recently
        faults = []
        if latency > max_latency:
            faults.append(f'median latency {latency:.0f} ms, above {max_latency:g} ms')
        if load is not None and load > limits.max_load:
            faults.append(f'{duration:.0f} ms per cloud at {1e3 * load / duration:.1f} Hz')
        if n_dropped > limits.max_drop_ratio * n_sent:
            faults.append(f'{n_dropped} of {n_sent} clouds dropped since the last report')
        if faults:
            return Level.WARN, f'too slow for the input: {"; ".join(faults)}'
        return Level.OK, f'median latency {latency:.1f} ms'
