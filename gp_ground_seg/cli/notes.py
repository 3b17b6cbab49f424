"""What a command says that is neither result nor error."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def note(message: str) -> None:
    """Say something on standard error."""
    print(f'gp-ground-seg: note: {message}', file=sys.stderr)


class _NoteHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        note(record.getMessage())


@contextmanager
def library_notes(level: int = logging.INFO) -> Iterator[None]:
    """Say what the library logs, such as that it compiles, within the block."""
    logger = logging.getLogger('gp_ground_seg')
    handler, before = _NoteHandler(), logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
