"""Levels that rise at once and fall only after a while."""

from __future__ import annotations

import dataclasses
from collections import deque

from gp_ground_seg.ros.health.status import Level, Status


class Hysteresis:
    """Holds the worst finding of the latest time, so that a passing fault can be seen.

    Silence is over with the first cloud: a STALE finding is held as a warning.
    """

    def __init__(self) -> None:
        # Ever milder and newer ones: what is older and no worse than another says nothing.
        self._held: deque[tuple[float, Status]] = deque()

    def hold(self, now: float, found: Status, recover_after: float) -> Status:
        """Return the status to report.

        Parameters
        ----------
        now : float
            Time on a steady clock [s], never less than before.
        found : Status
            What is found now.
        recover_after : float
            How long a finding outlives its cause [s].

        Returns
        -------
        Status
            `found`, with level and message of the worst finding since
            `recover_after` ago if that is worse.
        """
        while self._held and now - self._held[0][0] > recover_after:
            self._held.popleft()
        if found.level == Level.OK and not self._held:
            return found
        milder = Level.WARN if found.level == Level.STALE else found.level
        while self._held and self._held[-1][1].level <= milder:
            self._held.pop()
        if found.level > Level.OK:
            self._held.append((now, dataclasses.replace(found, level=milder)))
        since, worst = self._held[0] if self._held else (now, found)
        if found.level == Level.STALE or worst.level <= found.level:
            return found
        message = f'{found.message}; {now - since:.1f} s ago: {worst.message}'
        return dataclasses.replace(found, level=worst.level, message=message)
