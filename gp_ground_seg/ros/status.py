"""Status of a task, hysteresis of its level, and rates; ``now`` is on a steady clock [s]."""

from __future__ import annotations

from collections import deque
from enum import IntEnum
from typing import NamedTuple

RATE_WINDOW = 10.0  # time over which rates are taken [s]
Level = IntEnum('Level', 'OK WARN ERROR STALE', start=0)
"""Severity, with the values of ``diagnostic_msgs/DiagnosticStatus``."""


class Status(NamedTuple):
    """One judged task: name, level, one line of text, and the values behind it."""

    task: str
    level: Level
    message: str
    values: dict[str, str]


class Hysteresis:
    """Holds the worst level of the latest time, so that a passing fault can be seen.

    STALE ends with the first cloud: it is held as a warning.
    """

    def __init__(self) -> None:
        # Levels fall from old to new: a status that is older and no worse than another goes.
        self._held: deque[tuple[float, Status]] = deque()

    def hold(self, now: float, found: Status, recover_after: float) -> Status:
        """Return `found` with the worst level and message of the last `recover_after` [s]."""
        while self._held and now - self._held[0][0] > recover_after:
            self._held.popleft()
        level = Level.WARN if found.level == Level.STALE else found.level
        while self._held and self._held[-1][1].level <= level:
            self._held.pop()
        if level > Level.OK:
            self._held.append((now, found._replace(level=level)))
        since, worst = self._held[0] if self._held else (now, found)
        if found.level == Level.STALE or worst.level <= found.level:
            return found
        message = f'{found.message}; {now - since:.1f} s ago: {worst.message}'
        return found._replace(level=worst.level, message=message)


class Rate:
    """Events in all, and in the last `RATE_WINDOW` seconds."""

    def __init__(self) -> None:
        self.n_total = 0
        self._events: deque[tuple[float, int]] = deque()

    def count(self, now: float, n: int = 1) -> None:
        """Count `n` events."""
        self.n_total += n
        self._events.append((now, n))

    def window(self, now: float) -> tuple[int, float, float | None]:
        """Return events in the window, the time they span [s], their rate [Hz] if they do."""
        while self._events and now - self._events[0][0] > RATE_WINDOW:
            self._events.popleft()
        n_events = sum(n for _, n in self._events)
        span = self._events[-1][0] - self._events[0][0] if self._events else 0.0
        # The first event opens the span over which the others are counted.
        return n_events, span, (n_events - self._events[0][1]) / span if span > 0.0 else None
