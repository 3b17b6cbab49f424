"""Ground segmentation of LiDAR scans with Gaussian processes."""

from gp_ground_seg.config import Config
from gp_ground_seg.errors import ConfigError, GroundSegError, PointCloudError
from gp_ground_seg.labels import Label
from gp_ground_seg.segmentation import Segmentation
from gp_ground_seg.segmenter import GroundSegmenter

__version__ = '0.1.0'

__all__ = [
    'Config',
    'ConfigError',
    'GroundSegError',
    'GroundSegmenter',
    'Label',
    'PointCloudError',
    'Segmentation',
    '__version__',
]
