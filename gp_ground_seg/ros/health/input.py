"""What comes in, and what of it is refused."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gp_ground_seg.parameters.config import DiagnosticsConfig
from gp_ground_seg.ros.health.rate import Rate
from gp_ground_seg.ros.health.status import Level, Status, in_digits

TASK = 'input'


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
    is_simulated : bool
        Whether that clock follows /clock.
    """

    topic: str
    qos: str
    n_publishers: int
    ros_time: float
    is_simulated: bool = False


class InputStatistics:
    """Arrivals and refusals.

    Parameters
    ----------
    now : float
        Time on a steady clock [s], as in the methods.
    """

    def __init__(self, now: float) -> None:
        self._last_arrival = now
        self._arrivals = Rate()
        self._n_received = 0
        self._n_refused = 0
        self._n_time_jumps = 0
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
        self._arrivals.count(now)
        self._stamp, self._frame, self._fields = stamp, frame, ' '.join(fields)

    def refused(self, reason: str) -> None:
        """Count the cloud that arrived last as one that could not be processed."""
        self._recent = (self._recent[0], self._recent[1] + 1)
        self._n_refused += 1
        self._last_error = reason

    def time_jumped(self) -> None:
        """Count a jump back in time; the age of what came before means nothing any more."""
        self._n_time_jumps += 1
        self._stamp = None

    def report(self, now: float, facts: InputFacts, limits: DiagnosticsConfig) -> Status:
        """Judge the time since the last report."""
        self._reported = True
        level, message = self._judge(now, facts, limits)
        age = None if self._stamp is None else facts.ros_time - self._stamp
        values = {
            'Topic': facts.topic,
            'Publishers': str(facts.n_publishers),
            'QoS': facts.qos,
            'Events since startup': str(self._n_received),
            'Events in window': str(self._arrivals.events(now)),
            'Duration of window (s)': f'{self._arrivals.span(now):.3f}',
            'Actual frequency (Hz)': in_digits(self._arrivals.per_second(now), '.2f'),
            'Time since last cloud (s)': f'{now - self._last_arrival:.3f}',
            'Age of last stamp (s)': in_digits(age, '.3f'),
            'Clock': 'simulated, from /clock' if facts.is_simulated else 'system time',
            'Time jumps since startup': str(self._n_time_jumps),
            'Frame': self._frame,
            'Fields': self._fields,
            'Refused since startup': str(self._n_refused),
            'Last error': self._last_error,
        }
        return Status(TASK, level, message, values)

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
        if n_refused:
            is_too_much = n_refused > limits.max_refused_ratio * n_received
            return (
                Level.ERROR if is_too_much else Level.WARN,
                f'{n_refused} of {n_received} clouds refused: {self._last_error}',
            )
        # A stamp may be of any age: a recording is played at any time.
        return Level.OK, 'receiving'
