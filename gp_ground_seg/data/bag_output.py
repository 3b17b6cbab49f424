"""A bag of the ground and the obstacles of each cloud of another bag."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.bag_files import BAG_SUFFIXES
from gp_ground_seg.data.bags import BagReader, BagWriter
from gp_ground_seg.data.point_cloud2 import decode_cloud, encode_cloud, read_xyz, select_points

TOPICS = {'/ground': Label.GROUND, '/obstacles': Label.OBSTACLE}


def write_bag(
    source: Path,
    name: str,
    topic: str | None,
    storage: str | None,
    force: bool,
    segmenter: GroundSegmenter,
    folder: Path,
) -> Iterator[Segmentation]:
    """Write the bag `name` of the clouds of `source`, and yield the result for each.

    The bag appears when the iteration ends. Raises DataError if a cloud cannot be read, or the
    target cannot be, or exists and `force` is false.

    Parameters
    ----------
    topic : str or None
        PointCloud2 topic to segment, by default the only one.
    storage : str or None
        ``mcap`` or ``sqlite3``; by default that of the suffix, else that of the input.
    """
    here, target = source.resolve(), folder / name
    if target.resolve() in (here, *here.parents):
        raise DataError(f'{target}: is the input, or has it in it; name another output')
    with BagReader(source) as bag:
        topic = bag.pick_point_cloud_topic(topic)
        if not (storage or target.suffix in BAG_SUFFIXES or bag.storage == 'ros1'):
            storage = bag.storage
        with BagWriter(target, storage=storage, force=force) as output:
            for part in TOPICS:
                output.add_topic(part)
            for k, (_, time, raw) in enumerate(bag.messages([topic])):
                try:
                    cloud = decode_cloud(raw)
                    result = segmenter.segment(read_xyz(cloud))
                except PointCloudError as error:
                    place = f'message {k} of topic {topic}, recorded at {time} ns'
                    raise DataError(f'{source}: {place}: {error}') from error
                for part, label in TOPICS.items():
                    kept = select_points(cloud, result.label == label)
                    output.write(part, time, encode_cloud(kept))
                yield result
