"""What goes out, and to how many."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gp_ground_seg.ros.health.rate import Rate
from gp_ground_seg.ros.health.status import Level, Status, in_digits

TASK = 'output'


class OutputStatistics:
    """Messages per topic."""

    def __init__(self) -> None:
        self._rates: dict[str, Rate] = {}
        self._n_published: dict[str, int] = {}

    def published(self, now: float, topics: Iterable[str]) -> None:
        """Count one message on each of the `topics`."""
        for topic in topics:
            self._rates.setdefault(topic, Rate()).count(now)
            self._n_published[topic] = self._n_published.get(topic, 0) + 1

    def report(self, now: float, n_subscribers: Mapping[str, int]) -> Status:
        """List all topics; `n_subscribers` tells which there are, and who listens."""
        values = {}
        for topic, n in n_subscribers.items():
            rate = self._rates[topic].per_second(now) if topic in self._rates else None
            values[f'{topic} subscribers'] = str(n)
            values[f'{topic} rate (Hz)'] = in_digits(rate, '.2f')
            values[f'{topic} since startup'] = str(self._n_published.get(topic, 0))
        heard = [topic for topic, n in n_subscribers.items() if n]
        message = f'subscribed to: {", ".join(heard)}' if heard else 'nobody subscribes'
        return Status(TASK, Level.OK, message, values)
