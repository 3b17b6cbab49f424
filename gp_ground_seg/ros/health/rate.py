"""Events per second, and holes in their numbers."""

from __future__ import annotations

from collections import deque

WINDOW = 10.0
"""Time over which rates are taken [s]."""


class Rate:
    """Events of the last `WINDOW` seconds."""

    def __init__(self) -> None:
        self._events: deque[tuple[float, int]] = deque()

    def count(self, now: float, n: int = 1) -> None:
        """Count `n` events at the time `now` on a steady clock [s]."""
        self._events.append((now, n))
        self._forget(now)

    def events(self, now: float) -> int:
        """Events in the window."""
        self._forget(now)
        return sum(n for _, n in self._events)

    def span(self, now: float) -> float:
        """Time from the first to the last event in the window [s]."""
        self._forget(now)
        return self._events[-1][0] - self._events[0][0] if self._events else 0.0

    def per_second(self, now: float) -> float | None:
        """Rate in the window [Hz]; None where it takes a second event to tell."""
        span = self.span(now)
        # The first event opens the span that the others are counted over.
        return (self.events(now) - self._events[0][1]) / span if span > 0.0 else None

    def _forget(self, now: float) -> None:
        while self._events and now - self._events[0][0] > WINDOW:
            self._events.popleft()


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
