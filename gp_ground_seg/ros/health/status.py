"""A judged task, and how its numbers are written."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np


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


def in_digits(value: float | None, form: str) -> str:
    """Return `value` formatted, or ``unknown``."""
    return 'unknown' if value is None or np.isnan(value) else format(value, form)


def percentiles(name: str, seconds: Iterable[float]) -> dict[str, str]:
    """Return the median, 95th and 99th percentile of times [s], in ms; nothing of nothing."""
    times = 1e3 * np.array(list(seconds))
    if not len(times):
        return {}
    return {f'{name} p{q} (ms)': f'{np.percentile(times, q):.2f}' for q in (50, 95, 99)}
