"""Exceptions that carry one clear line for the user."""

import importlib
from typing import Any


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


def require(module: str, extra: str) -> Any:
    """Import a module of an optional package.

    Raises a MissingDependencyError, with the `extra` of ours that installs it, if that fails.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(
            f'{module.split(".")[0]} is not installed, or does not work here ({error}): '
            f"pip install 'gp_ground_seg[{extra}]'"
        ) from error
