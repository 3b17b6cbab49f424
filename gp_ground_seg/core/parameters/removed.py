"""Parameters, their values, and options of earlier releases, and what to use instead.

Files, commands and the library refuse them with the sentence here. A node leaves them out and
warns, for one release. A new line is all that another one needs.
"""

from __future__ import annotations

REMOVED: dict[str, str] = {
    'learning.mode=every_k': 'use every_frame, or fixed, which takes less time',
    'learning.mode=first_frame': 'use every_frame, or fixed with your values in observation',
    'learning.period': 'leave it out: the mode every_k is gone',
    'learning.scope': 'leave it out: a frame has one set of hyper-parameters',
    'learning.warm_start': 'leave it out: learning starts from the lines of each frame',
    'learning.max_time': 'use learning.max_evaluations',
    'runtime.n_threads': 'leave it out: a scan takes one thread; --workers takes several scans',
    'bench --threads': 'leave it out: a scan takes one thread',
}
"""What to use instead, by ``NAME``, by ``NAME=VALUE`` where only a value is removed, or by the
option of a command."""


def removal(name: str, value: object = None) -> str:
    """Say what to use instead of a name, or of a value of it; empty if it is not removed."""
    for key in (name, f'{name}={value}'):
        if key in REMOVED:
            return f'{key} was removed: {REMOVED[key]}'
    return ''
