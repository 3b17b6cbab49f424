"""What the library logs, through the log of the node."""

from __future__ import annotations

import logging
from typing import Any

_LIBRARY = logging.getLogger('gp_ground_seg')


class LibraryLog(logging.Handler):
    """Passes the library's messages on to the logger of a node, from now until `close`.

    Parameters
    ----------
    logger : rclpy.impl.rcutils_logger.RcutilsLogger
        Logger of the node.
    """

    def __init__(self, logger: Any) -> None:
        super().__init__()
        self._logger = logger
        _LIBRARY.setLevel(logging.INFO)
        _LIBRARY.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Log one message; rclpy wants a line of code for each severity."""
        message = record.getMessage()
        if record.levelno >= logging.ERROR:
            self._logger.error(message)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(message)
        else:
            self._logger.info(message)

    def close(self) -> None:
        """Pass nothing on any more."""
        _LIBRARY.removeHandler(self)
        super().close()
