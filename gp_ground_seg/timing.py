"""Stage times, from a clock that the caller brings."""

from __future__ import annotations

from collections.abc import Callable


class StageTimer:
    """Collects the time between successive marks.

    Parameters
    ----------
    clock : callable
        Returns seconds; only differences are used.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._start = self._last = clock()
        self.seconds: dict[str, float] = {}

    def mark(self, stage: str) -> None:
        """Book the time since the mark before under `stage`."""
        now = self._clock()
        self.seconds[stage] = now - self._last
        self.seconds['total'] = now - self._start
        self._last = now
