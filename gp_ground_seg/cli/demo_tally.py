"""Counts of the demo: what was sent, what came back, when, and how right it is."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from gp_ground_seg.cli.demo_check import ScanCheck, check_scan
from gp_ground_seg.data.point_cloud2 import CloudMessage, decode_cloud, stamp_of
from gp_ground_seg.evaluation.metrics import Confusion

GROUND = '/ground'
OBSTACLES = '/obstacles'
OUTPUTS = (GROUND, OBSTACLES)
"""Topics of the node."""
BACKLOG = 60
"""Scans that wait to be looked at, so that this does not slow down the playing: 360 MB."""

Stamp = tuple[int, int]


@dataclass
class _Trip:
    """A scan on its way: the how manieth, what was sent, when [ns], and what is back."""

    number: int
    raw: bytes
    sent: int
    clouds: dict[str, CloudMessage] = field(default_factory=dict)
    arrived: int = 0


class Tally:
    """Follows scans through the node, keeps only counts.

    `look` has to be called in the end: scans that came back wait for it.

    Parameters
    ----------
    shown : int
        Which of the scans to keep for the picture, counted from 0.

    Attributes
    ----------
    n_sent, n_back : int
        Scans sent; scans of which both clouds came back.
    n_points, n_missing, n_repeated, n_altered, n_foreign : int
        Sums over the scans that came back, see `ScanCheck`.
    n_stray : int
        Clouds that belong to no scan sent, or came a second time.
    confusion : Confusion
        Right and wrong labels of the scans that came back.
    latencies : list of float
        Time between sending a scan and the arrival of the second of its clouds [s].
    picture : ScanCheck or None
        The scan kept, the nearest before it if it was lost.
    picture_number : int
        Which one that is.
    """

    def __init__(self, shown: int) -> None:
        self._shown = shown
        self._on_the_way: dict[Stamp, _Trip] = {}
        self._back: deque[_Trip] = deque()
        self._first_back = self._last_back = 0
        self.n_sent = self.n_back = 0
        self.n_points = self.n_missing = self.n_repeated = self.n_altered = self.n_foreign = 0
        self.n_stray = 0
        self.confusion = Confusion()
        self.latencies: list[float] = []
        self.picture: ScanCheck | None = None
        self.picture_number = 0

    @property
    def n_lost(self) -> int:
        """Scans of which a cloud, or both, never came back."""
        return self.n_sent - self.n_back

    @property
    def is_partition_exact(self) -> bool:
        """Whether every point of the scans that came back did so once and unchanged."""
        return not (
            self.n_missing or self.n_repeated or self.n_altered or self.n_foreign or self.n_stray
        )

    @property
    def rate(self) -> float | None:
        """Scans back per second [Hz], None with less than two."""
        seconds = 1e-9 * (self._last_back - self._first_back)
        return (self.n_back - 1) / seconds if self.n_back > 1 and seconds > 0.0 else None

    def latency(self, percentile: float) -> float:
        """Percentile of the latencies [s]; NaN if nothing came back."""
        return float(np.percentile(self.latencies, percentile)) if self.latencies else np.nan

    def sent(self, _topic: str, raw: bytes, now: int) -> None:
        """Note a scan that is being sent, at system time `now` [ns]."""
        self._on_the_way[stamp_of(decode_cloud(raw))] = _Trip(self.n_sent, raw, now)
        self.n_sent += 1

    def arrived(self, topic: str, cloud: CloudMessage, now: int) -> None:
        """Note a cloud that came back on `topic`, at system time `now` [ns]."""
        trip = self._on_the_way.get(stamp_of(cloud))
        if trip is None or topic in trip.clouds:
            self.n_stray += 1
            return
        trip.clouds[topic] = cloud
        trip.arrived = max(trip.arrived, now)
        if len(trip.clouds) == len(OUTPUTS):
            del self._on_the_way[stamp_of(cloud)]
            self._back.append(trip)
            self.n_back += 1
            self.latencies.append(1e-9 * (trip.arrived - trip.sent))
            self._first_back = min(self._first_back or trip.arrived, trip.arrived)
            self._last_back = max(self._last_back, trip.arrived)
            self.look(BACKLOG)

    def look(self, n_left: int = 0) -> None:
        """Check the scans that came back, but for the newest `n_left`."""
        while len(self._back) > n_left:
            self._check(self._back.popleft())

    def _check(self, trip: _Trip) -> None:
        check = check_scan(decode_cloud(trip.raw), trip.clouds[GROUND], trip.clouds[OBSTACLES])
        self.n_points += check.n_points
        self.n_missing += check.n_missing
        self.n_repeated += check.n_repeated
        self.n_altered += check.n_altered
        self.n_foreign += check.n_foreign
        self.confusion += check.confusion
        if self.picture is None or trip.number <= self._shown:
            self.picture, self.picture_number = check, trip.number
