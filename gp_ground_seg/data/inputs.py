"""Clouds of an input: a file of any format, a folder of files, a data set, a bag."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from gp_ground_seg.core.errors import LOGGER, DataError, shown
from gp_ground_seg.core.pipeline.points import take_points
from gp_ground_seg.data.bags import BAG_SUFFIXES, METADATA_FILE, BagReader, decode_cloud
from gp_ground_seg.data.cloud_files import KITTI_COLUMNS, NUSCENES_SUFFIX, SUFFIXES, read_file
from gp_ground_seg.data.clouds import Cloud
from gp_ground_seg.data.files import naming
from gp_ground_seg.data.point_cloud2 import read_fields, read_xyz

# Where the scans are in a sequence of SemanticKITTI or a root of nuScenes.
_SCAN_FOLDERS = ('.', 'velodyne', 'samples/LIDAR_TOP')
_OUTPUT = re.compile(r'_ground(_ground|_obstacles|_surface)?$')
"""What `segment` adds to the name of a scan whose output goes beside it."""


@dataclass(frozen=True)
class Input:
    """One cloud, not read yet."""

    name: str  # unique among its `Inputs`; output is named after it
    title: str  # name to show: that of the file, or of the bag with the number of the message
    path: Path  # the file, or the bag
    # returns the `Cloud`; raises DataError if it cannot be read, or can be no scan
    read: Callable[[], Cloud]

    def __str__(self) -> str:
        """Path."""
        return str(self.path)


@dataclass(frozen=True)
class Inputs(Sequence[Input]):
    """Clouds in their order: ``len()``, iteration and indices; read one at a time.

    A bag is read from its beginning each time; its clouds are best iterated over.
    """

    path: Path
    files: Sequence[Input]
    topic: str | None = None  # of a bag
    n_messages: int = 0  # on it

    def __len__(self) -> int:
        """Count the clouds."""
        return self.n_messages or len(self.files)

    def __iter__(self) -> Iterator[Input]:
        """Yield each cloud, not read yet."""
        yield from self.files  # of a bag none
        for k, (place, _, raw) in enumerate(self.messages()):
            title = shown(f'{self.path.name}[{k}]')
            yield Input(f'{k:06d}', title, self.path, partial(_decode, raw, place))

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield what names each cloud of a bag, its recorded time [ns], and its CDR bytes."""
        if self.topic is None:
            return
        with BagReader(self.path) as bag:
            for k, (_, time, raw) in enumerate(bag.messages([self.topic])):
                place = f'message {k} of topic {self.topic}, recorded at {time} ns'
                yield f'{self.path}: {place}', time, raw

    def __getitem__(self, index: Any) -> Any:
        """Return one cloud, not read yet; IndexError beyond the last."""
        if not 0 <= index < len(self):
            raise IndexError(f'{self.path}: {index} of {len(self)} clouds')
        return next(islice(self, index, None))


def list_inputs(
    source: str | Path, columns: int = KITTI_COLUMNS, topic: str | None = None
) -> Inputs:
    """Return the clouds of `source`; DataError if there are none.

    Parameters
    ----------
    source : str or Path
        A file of a known format; a folder of such files, of one or several formats; a sequence
        of SemanticKITTI; the root of nuScenes; a bag.
    columns : int
        Numbers of a point in ``.bin`` files. ``.pcd.bin`` of nuScenes has five, and is recognised
        by its name.
    topic : str or None
        PointCloud2 topic of a bag, by default the only one.
    """
    path = Path(source)
    if holds_bag(path):
        with BagReader(path) as bag:
            name = bag.pick_point_cloud_topic(topic)
            return Inputs(path, (), name, bag.n_messages(name))
    if topic is not None:
        raise DataError(f'--topic: is for bags, which {source} is not')
    files = _find_files(path)
    stems = Counter(map(_stem, files))
    names = (_stem(file) if stems[_stem(file)] == 1 else file.name for file in files)
    return Inputs(path, [
        Input(name, shown(file.name), file, partial(read_file, file, columns))
        for name, file in zip(names, files, strict=True)
    ])  # fmt: skip


def holds_bag(path: Path) -> bool:
    """Whether `path` is a bag, or a folder that has bag files and no scans in it."""
    if not path.is_dir():
        return path.suffix in BAG_SUFFIXES
    children = list(path.iterdir())
    has_bags = any(child.suffix in BAG_SUFFIXES for child in children)
    # Of bag files without metadata `BagReader` says what is missing.
    return (path / METADATA_FILE).is_file() or (has_bags and not any(map(_is_scan, children)))


def _is_scan(path: Path) -> bool:
    """Whether a file of a folder is taken for a scan."""
    return path.suffix.lower() in SUFFIXES


def _find_files(source: Path) -> Sequence[Path]:
    accepted = ', '.join(SUFFIXES)
    if not source.exists():
        raise DataError(f'{source}: no such file or folder')
    if not source.is_dir():
        if source.suffix.lower() not in SUFFIXES:
            raise DataError(
                f'{source}: not a scan or bag; accepted are {accepted}, .bag, .mcap and .db3 '
                'files, folders of scans and rosbag2 folders; of a text, save x, y, z as .npy'
            )
        return [source]
    for name in _SCAN_FOLDERS:
        folder = source / name
        if files := sorted(filter(_is_scan, folder.glob('*')), key=_in_order):
            return _without_output(files)
    raise DataError(f'{source}: no {accepted} file in it, and not a rosbag2 folder')


def _without_output(files: Sequence[Path]) -> Sequence[Path]:
    """Leave out files that are named as the output of another one."""
    stems = {_stem(file) for file in files}
    outputs = {stem for stem in stems if _OUTPUT.sub('', stem) in stems - {stem}}
    kept = [file for file in files if _stem(file) not in outputs]
    if n_left_out := len(files) - len(kept):
        LOGGER.info('output of earlier runs left out: %d of %d files', n_left_out, len(files))
    return kept


def _in_order(path: Path) -> tuple[list[str | int], str]:
    """Key of a file: numbers in its name count as numbers, so scan2 is before scan10."""
    words = re.split('([0-9]+)', path.name)
    return [int(word) if k % 2 else word for k, word in enumerate(words)], path.name


def _stem(path: Path) -> str:
    return path.stem.removesuffix('.pcd') if path.name.endswith(NUSCENES_SUFFIX) else path.stem


def _decode(raw: bytes, place: str) -> Cloud:
    with naming(place):
        message = decode_cloud(raw)
        # A cloud without points is one of a drive, and no error as a file of its own is.
        return Cloud(read_fields(message), take_points(read_xyz(message)))
