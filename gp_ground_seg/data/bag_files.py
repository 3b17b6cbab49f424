"""What is checked before a bag is read or written: its path, and sqlite files that were cut."""

from __future__ import annotations

import struct
from pathlib import Path

from gp_ground_seg.core.errors import DataError

POINT_CLOUD2 = 'sensor_msgs/msg/PointCloud2'
METADATA_FILE = 'metadata.yaml'
SUFFIX_OF_STORAGE = {'mcap': '.mcap', 'sqlite3': '.db3'}
STORAGE_OF_SUFFIX = {suffix: storage for storage, suffix in SUFFIX_OF_STORAGE.items()}
BAG_SUFFIXES = ('.bag', *STORAGE_OF_SUFFIX)

_FOLDER_SUFFIXES = ('.mcap', '.db3', '.db3-shm', '.db3-wal', '.zstd', '.zst')
REPAIR = {
    '.bag': '`rosbag reindex` saves the readable part',
    '.mcap': '`mcap recover` saves the readable part',
    '.db3': '`sqlite3 .recover` saves the readable part',
    '': '`ros2 bag reindex` writes metadata.yaml anew',
}
"""What can repair a damaged bag, by its suffix; '' for a folder."""


def is_bag_folder(path: Path) -> bool:
    """Whether a folder holds a rosbag2 bag and nothing else."""
    return (path / METADATA_FILE).is_file() and all(
        child.is_file() and (child.name == METADATA_FILE or child.suffix in _FOLDER_SUFFIXES)
        for child in path.iterdir()
    )


def storage_of(path: Path) -> str:
    """Storage of a bag, or ``ros1``; DataError with the next step if `path` cannot be one."""
    if not path.exists():
        raise DataError(f'{path}: no such file or folder')
    if not path.is_dir():
        if path.suffix not in BAG_SUFFIXES:
            raise DataError(
                f'{path}: not a bag; accepted are ROS 1 .bag, .mcap, .db3 and rosbag2 folders'
            )
        return STORAGE_OF_SUFFIX.get(path.suffix, 'ros1')
    if not (path / METADATA_FILE).is_file():
        files = sorted(child.name for child in path.iterdir() if child.suffix in BAG_SUFFIXES)
        hint = f'; bag files in it, to be given one by one: {", ".join(files)}' if files else ''
        raise DataError(f'{path}: not a rosbag2 folder (no {METADATA_FILE} in it){hint}')
    return 'sqlite3' if any(path.glob('*.db3*')) else 'mcap'


def check_sqlite_path(path: Path) -> None:
    """Raise DataError for a path that rosbags, which gives it to sqlite as a URI, misreads."""
    awkward = sorted(set('?#%') & set(str(path.absolute())))
    if awkward:
        raise DataError(f'{path}: a sqlite3 bag cannot have {" ".join(awkward)} in its path')


def check_sqlite_file(path: Path) -> None:
    """Raise DataError where a sqlite file is cut off, or in part still in a journal.

    sqlite itself would read zeros, or older messages.
    """
    check_sqlite_path(path)
    with path.open('rb') as file:
        header = file.read(100)
    # The format is that of https://www.sqlite.org/fileformat.html.
    if len(header) == 100 and header[24:28] == header[92:96]:
        page_size, n_pages = struct.unpack_from('>16xH10xI', header)
        # 65536 does not fit into the two bytes.
        size, wanted = path.stat().st_size, n_pages * (65536 if page_size == 1 else page_size)
        if size < wanted:
            raise DataError(f'{path}: truncated, {size} bytes where its header says {wanted}')
    for journal in (path.with_name(path.name + ending) for ending in ('-wal', '-journal')):
        if journal.exists() and journal.stat().st_size > 0:
            hint = f'`sqlite3 {path.name} vacuum` completes it'
            raise DataError(f'{path}: was not closed, some of it is in {journal.name}; {hint}')


def resolve_storage(path: str | Path, wanted: str | None = None) -> str:
    """Storage of a new bag: `wanted`, or by its suffix; DataError if the two contradict."""
    suffix = Path(path).suffix
    if suffix == '.bag':
        raise DataError(f'{path}: only ROS 2 bags are written; use .mcap, .db3 or a folder name')
    implied = STORAGE_OF_SUFFIX.get(suffix)
    storage = wanted or implied or 'mcap'
    if implied not in (None, storage):
        raise DataError(
            f'{path}: ends in {suffix}, which is not {storage} ({SUFFIX_OF_STORAGE[storage]})'
        )
    if storage == 'sqlite3':
        check_sqlite_path(Path(path))
    return storage
