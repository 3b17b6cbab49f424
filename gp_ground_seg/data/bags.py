"""Bags of any kind in, rosbag2 out: the names other modules use."""

from gp_ground_seg.data.bag_files import BAG_SUFFIXES, is_bag
from gp_ground_seg.data.bag_reader import BagReader, open_bag
from gp_ground_seg.data.bag_writer import BagWriter, resolve_storage
from gp_ground_seg.data.cloud_codec import (
    CloudMessage,
    PointField,
    cloud_from_columns,
    decode_cloud,
    encode_cloud,
)
from gp_ground_seg.data.rosbags_support import POINT_CLOUD2, BagTopic, cloud_topic, jazzy_topic

__all__ = [
    'BAG_SUFFIXES',
    'POINT_CLOUD2',
    'BagReader',
    'BagTopic',
    'BagWriter',
    'CloudMessage',
    'PointField',
    'cloud_from_columns',
    'cloud_topic',
    'decode_cloud',
    'encode_cloud',
    'is_bag',
    'jazzy_topic',
    'open_bag',
    'resolve_storage',
]
