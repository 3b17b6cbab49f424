"""Exceptions that carry one clear line for the user."""


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
