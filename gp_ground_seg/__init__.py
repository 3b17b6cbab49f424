"""Ground segmentation of LiDAR scans with Gaussian processes."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gp_ground_seg.core.errors import ConfigError, GroundSegError, PointCloudError
    from gp_ground_seg.core.frame import Label
    from gp_ground_seg.core.parameters.config import Config
    from gp_ground_seg.core.result import Segmentation
    from gp_ground_seg.core.segmenter import GroundSegmenter
    from gp_ground_seg.data import semantic_kitti

__version__ = '0.5.0'

__all__ = [
    'Config',
    'ConfigError',
    'GroundSegError',
    'GroundSegmenter',
    'Label',
    'PointCloudError',
    'Segmentation',
    '__version__',
    'semantic_kitti',
]

_MODULES = {
    'Config': 'core.parameters.config',
    'ConfigError': 'core.errors',
    'GroundSegError': 'core.errors',
    'GroundSegmenter': 'core.segmenter',
    'Label': 'core.frame',
    'PointCloudError': 'core.errors',
    'Segmentation': 'core.result',
    'semantic_kitti': 'data.semantic_kitti',
}


# numba and scipy take most of a second to import: a program that gets a
# signal meanwhile, or that prints its usage, does not wait for them.
def __getattr__(name: str) -> object:
    """Import the module that defines `name`."""
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    module = importlib.import_module(f'{__name__}.{_MODULES[name]}')
    value = getattr(module, name, module)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
