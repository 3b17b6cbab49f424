"""Clouds that went to the node and back: losses, latency, growth. No ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

STEADY_FACTOR, STEADY_MARGIN = 1.5, 0.02
"""By how much the latency of the last quarter may exceed that of the second one, in which the
queue of the node has filled [1, s]."""
SETTLED = 0.1
"""Share of a run at whose start memory is still being taken in."""


@dataclass
class Trip:
    """A cloud: when it was sent, when the last of its results was back; system time [ns]."""

    sent: int
    back: int | None = None

    @property
    def latency(self) -> float:
        """Time in between [s]; NaN where it did not come back."""
        return np.nan if self.back is None else 1e-9 * (self.back - self.sent)


@dataclass(frozen=True)
class RateResult:
    """What became of clouds sent at one rate.

    Attributes
    ----------
    asked, sent : float
        Rate asked for and rate reached by the sender [Hz].
    n_sent, n_back, n_dropped : int
        Clouds sent, clouds whose results came back, clouds the node says it dropped.
    p50, p95, p99, worst : float
        Latencies [s]; NaN if nothing came back.
    is_newest_back : bool
        Whether the last cloud sent came back.
    is_bounded : bool
        Whether latency did not grow from the second quarter to the last.
    """

    asked: float
    sent: float
    n_sent: int
    n_back: int
    n_dropped: int
    p50: float
    p95: float
    p99: float
    worst: float
    is_newest_back: bool
    is_bounded: bool

    @property
    def n_lost(self) -> int:
        """Clouds that did not come back."""
        return self.n_sent - self.n_back

    @property
    def is_accounted(self) -> bool:
        """Whether the node reported as dropped what did not come back."""
        return self.n_dropped == self.n_lost


def rate_result(asked: float, trips: Sequence[Trip], n_dropped: int) -> RateResult:
    """Sum up the trips of clouds sent at a rate of `asked` [Hz]."""
    latency = np.array([trip.latency for trip in trips])
    quarter = len(trips) // 4
    early = _percentile(latency[quarter : 2 * quarter], 50)
    late = _percentile(latency[3 * quarter :], 50)
    seconds = 1e-9 * (trips[-1].sent - trips[0].sent)
    return RateResult(
        asked=asked,
        sent=(len(trips) - 1) / seconds if seconds > 0.0 else np.nan,
        n_sent=len(trips),
        n_back=int(np.count_nonzero(np.isfinite(latency))),
        n_dropped=n_dropped,
        p50=_percentile(latency, 50),
        p95=_percentile(latency, 95),
        p99=_percentile(latency, 99),
        worst=_percentile(latency, 100),
        is_newest_back=trips[-1].back is not None,
        is_bounded=bool(late <= STEADY_FACTOR * early + STEADY_MARGIN),
    )


@dataclass(frozen=True)
class MemoryResult:
    """Memory of the node over a run.

    Attributes
    ----------
    n_clouds : int
        Clouds it was sent, one after the other.
    start, end : float
        Median resident memory of the tenth of the run after the first one, and of the
        last [bytes].
    peak : float
        Most it ever held, from its start on [bytes].
    """

    n_clouds: int
    start: float
    end: float
    peak: float

    @property
    def growth(self) -> float:
        """Relative growth."""
        return self.end / self.start - 1.0


def memory_result(resident: Sequence[int], peak: int) -> MemoryResult:
    """Sum up the resident memory after each cloud [bytes].

    Raises
    ------
    ValueError
        If there are less than ten values.
    """
    n = len(resident)
    share = int(SETTLED * n)
    if share == 0:
        raise ValueError(f'{n} values: too few to tell growth')
    return MemoryResult(
        n_clouds=n,
        start=float(np.median(resident[share : 2 * share])),
        end=float(np.median(resident[-share:])),
        peak=float(peak),
    )


def _percentile(latency: np.ndarray[tuple[int], np.dtype[np.float64]], q: float) -> float:
    known = latency[np.isfinite(latency)]
    return float(np.percentile(known, q)) if len(known) else np.nan
