"""A copy of a bag in which ground and obstacles follow each point cloud."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.bag_files import BAG_SUFFIXES
from gp_ground_seg.data.bags import BagReader, BagWriter, cloud_topic
from gp_ground_seg.data.point_cloud2 import decode_cloud, encode_cloud, read_xyz, select_points

GROUND_TOPIC, OBSTACLES_TOPIC = '/ground', '/obstacles'
_TOPIC_NAME = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')


@dataclass(frozen=True)
class BagOutput:
    """A bag to write for each bag.

    Attributes
    ----------
    topic : str or None
        PointCloud2 topic to segment, by default the only one.
    ground_topic, obstacles_topic : str
        Topics of the two clouds that follow each cloud.
    drop : sequence of str
        Topics that are left out.
    storage : str or None
        ``mcap`` or ``sqlite3``; by default that of the suffix, else that of the input.
    """

    topic: str | None = None
    ground_topic: str = GROUND_TOPIC
    obstacles_topic: str = OBSTACLES_TOPIC
    drop: Sequence[str] = ()
    storage: str | None = None

    def write(
        self, source: Path, target: Path, segmenter: GroundSegmenter, *, force: bool
    ) -> Iterator[Segmentation]:
        """Write the bag `target`, and yield the result for each cloud of `source`.

        The bag appears when the iteration ends. Raises DataError if a topic or the target cannot
        be, or a cloud cannot be read.
        """
        here = source.resolve()
        if target.resolve() in (here, *here.parents):
            raise DataError(f'{target}: is the input, or has it in it; name another output')
        parts = {self.ground_topic: Label.GROUND, self.obstacles_topic: Label.OBSTACLE}
        with BagReader(source) as bag:
            topic, copied = bag.pick_point_cloud_topic(self.topic), self._copied_topics(bag)
            storage = self._storage(bag, target)
            with BagWriter(target, storage=storage, force=force) as output:
                for name in copied:
                    output.add_topic(bag.topic(name))
                for name in parts:
                    output.add_topic(cloud_topic(name))
                n_done = 0
                for name, time, raw in bag.messages([*copied, topic]):
                    if name in copied:
                        output.write(name, time, raw)
                    if name != topic:
                        continue
                    try:
                        cloud = decode_cloud(raw)
                        result = segmenter.segment(read_xyz(cloud))
                    except PointCloudError as error:
                        place = f'message {n_done} of topic {topic}, recorded at {time} ns'
                        raise DataError(f'{source}: {place}: {error}') from error
                    for part, label in parts.items():
                        kept = select_points(cloud, result.label == label)
                        output.write(part, time, encode_cloud(kept))
                    yield result
                    n_done += 1

    def _copied_topics(self, bag: BagReader) -> list[str]:
        """Topics that are copied; DataError if one to drop is not there, or a name is taken."""
        for name in self.drop:
            bag.topic(name)  # Raises where there is none.
        copied = [name for name in bag.topics if name not in self.drop]
        topics = {'--ground-topic': self.ground_topic, '--obstacles-topic': self.obstacles_topic}
        for option, name in topics.items():
            if not _TOPIC_NAME.fullmatch(name):
                raise DataError(
                    f'{option} {name}: must be a full topic name, as in {GROUND_TOPIC}'
                )
            if name in copied:
                choices = f'choose another with {option}, or leave that one out with --drop {name}'
                raise DataError(f'{bag.path}: has a topic {name} already; {choices}')
        if self.ground_topic == self.obstacles_topic:
            raise DataError(
                f'--obstacles-topic {self.obstacles_topic}: is the topic of the ground as well'
            )
        return copied

    def _storage(self, bag: BagReader, target: Path) -> str | None:
        if self.storage or target.suffix in BAG_SUFFIXES or bag.storage == 'ros1':
            return self.storage
        return bag.storage
