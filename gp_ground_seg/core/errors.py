"""What the user is told: errors of one clear line, and messages of the library."""

import importlib
import logging
import shlex
import sys
import sysconfig
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, SupportsInt

LOGGER = logging.getLogger('gp_ground_seg')
"""Of the whole library."""


class GroundSegError(Exception):
    """Root of every error raised on purpose by this package."""


class ConfigError(GroundSegError, ValueError):
    """A parameter is unknown, of the wrong type, or out of range."""


class PointCloudError(GroundSegError, ValueError):
    """A point cloud has a shape, type or layout that cannot be read."""


class DataError(GroundSegError):
    """A file, folder or bag is missing, malformed or would be overwritten."""


class MissingDependencyError(GroundSegError, ImportError):
    """An optional package that this command needs is not installed."""


def in_one_line(error: BaseException) -> str:
    """Text of an error, shortened to one line, or the name of its type if it has none."""
    return textwrap.shorten(str(error), 200, placeholder=' ...') or type(error).__name__


def shown(text: object) -> str:
    """Text as it is shown in a terminal: one line, control characters and surrogates escaped.

    Names of files and topics may hold anything: commands to the terminal, line ends, no UTF-8.
    """
    return ''.join(c if c.isprintable() else repr(c)[1:-1] for c in str(text))


def reason_of(error: Exception) -> str:
    """Why the operating system refused, without number and name of the file."""
    return getattr(error, 'strerror', None) or in_one_line(error)


def install_hint(packages: str) -> str:
    """Return a command that installs `packages` of PyPI for this interpreter, or where they go.

    The Python of a distribution takes them in a virtual environment only (PEP 668).
    """
    marker = Path(sysconfig.get_path('stdlib'), 'EXTERNALLY-MANAGED')
    if sys.prefix == sys.base_prefix and marker.exists():
        return f'pip install {packages}, in a virtual environment: see docs/install.md'
    return f'{shlex.quote(sys.executable)} -m pip install {packages}'


def require(module: str, packages: str) -> Any:
    """Import a module of an optional package.

    Raises a MissingDependencyError, with the `packages` of PyPI that it needs, if that fails.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(
            f'{module.split(".")[0]} is not installed, or does not work here ({error}): '
            f'{install_hint(packages)}'
        ) from error


def in_thousands(number: SupportsInt) -> str:
    """Return a whole number as in ``180 385``."""
    return f'{int(number):_}'.replace('_', ' ')


_logged: set[str] = set()


def log_once(level: int, text: str, *values: object) -> None:
    """Log a message the first time that it is to be logged, whatever its values."""
    if text not in _logged:
        _logged.add(text)
        LOGGER.log(level, text, *values)


@contextmanager
def messages_passed_to(
    receive: Callable[[int, str], object], level: int = logging.INFO
) -> Iterator[None]:
    """Call `receive` with severity and text of each message of a `level` or more in the block."""
    handler, before = logging.Handler(), LOGGER.level
    handler.emit = lambda record: receive(record.levelno, record.getMessage())  # type: ignore
    LOGGER.addHandler(handler)
    LOGGER.setLevel(level)
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(before)
