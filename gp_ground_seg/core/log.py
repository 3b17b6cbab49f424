"""Messages of the library, passed to where they are read: a terminal, a node, a process."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import SupportsInt

LOGGER = logging.getLogger('gp_ground_seg')
"""Of the whole library."""
Receive = Callable[[int, str], object]
"""Takes the severity of a message, as in `logging`, and its text."""


def in_thousands(number: SupportsInt) -> str:
    """Return a whole number as in ``180 385``."""
    return f'{int(number):_}'.replace('_', ' ')


class _Handler(logging.Handler):
    def __init__(self, receive: Receive) -> None:
        super().__init__()
        self._receive = receive

    def emit(self, record: logging.LogRecord) -> None:
        self._receive(record.levelno, record.getMessage())


@contextmanager
def passed_to(receive: Receive, level: int = logging.INFO) -> Iterator[None]:
    """Call `receive` with each message of that severity or more within the block."""
    handler, before = _Handler(receive), LOGGER.level
    LOGGER.addHandler(handler)
    LOGGER.setLevel(level)
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(before)
