"""What the library logs, told where it is read: on a terminal, by a node, in another process."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LOGGER = logging.getLogger('gp_ground_seg')
"""Of the whole library."""
Tell = Callable[[int, str], object]
"""Takes the severity of a message, as in `logging`, and its text."""


class _Teller(logging.Handler):
    def __init__(self, tell: Tell) -> None:
        super().__init__()
        self._tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        self._tell(record.levelno, record.getMessage())


@contextmanager
def told(tell: Tell, level: int = logging.INFO) -> Iterator[None]:
    """Call `tell` with each message of that severity or more within the block."""
    handler, before = _Teller(tell), LOGGER.level
    LOGGER.addHandler(handler)
    LOGGER.setLevel(level)
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(before)
