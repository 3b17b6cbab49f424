"""What is checked before a bag is read or written: its path, metadata.yaml, damaged files."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath

import yaml

from gp_ground_seg.core.errors import DataError, MissingDependencyError, in_one_line

POINT_CLOUD2 = 'sensor_msgs/msg/PointCloud2'
METADATA_FILE = 'metadata.yaml'
SUFFIX_OF_STORAGE = {'mcap': '.mcap', 'sqlite3': '.db3'}
STORAGE_OF_SUFFIX = {suffix: storage for storage, suffix in SUFFIX_OF_STORAGE.items()}
BAG_SUFFIXES = ('.bag', *STORAGE_OF_SUFFIX)
PACKED_SUFFIXES = ('.zstd', '.zst')

_FOLDER_SUFFIXES = ('.mcap', '.db3', '.db3-shm', '.db3-wal', *PACKED_SUFFIXES)
# Part of an error of reading -> a hint at what to do.
_NEXT_STEP = {
    'EndOfFile': 'damaged; `mcap recover` saves the readable part',
    'not indexed': 'truncated, or still being recorded; `rosbag reindex` saves the readable part',
    'index looks damaged': 'truncated? `rosbag reindex` saves the readable part',
    'malformed': 'truncated or overwritten? `sqlite3 .recover` saves the readable part',
}


def is_bag_folder(path: Path) -> bool:
    """Whether a folder holds a rosbag2 bag and nothing else."""
    return (path / METADATA_FILE).is_file() and all(
        child.is_file() and (child.name == METADATA_FILE or child.suffix in _FOLDER_SUFFIXES)
        for child in path.iterdir()
    )


def check_is_bag(path: Path) -> None:
    """Raise `DataError` with the next step if `path` cannot be a bag."""
    if not path.exists():
        raise DataError(f'{path}: no such file or folder')
    if path.is_dir() and not (path / METADATA_FILE).is_file():
        files = sorted(child.name for child in path.iterdir() if child.suffix in BAG_SUFFIXES)
        hint = f'; bag files in it, to be given one by one: {", ".join(files)}' if files else ''
        raise DataError(f'{path}: not a rosbag2 folder (no {METADATA_FILE} in it){hint}')
    if not path.is_dir() and path.suffix not in BAG_SUFFIXES:
        raise DataError(
            f'{path}: not a bag; accepted are ROS 1 .bag, .mcap, .db3 and rosbag2 folders'
        )


def list_files(path: Path) -> tuple[list[Path], dict[str, int], bool]:
    """Files of a bag, messages of each topic, and whether each is packed, by metadata.yaml.

    Of the rest nothing is needed to read a bag. A bag of one file has no such counts.
    """
    if not path.is_dir():
        return [path], {}, False
    metadata = path / METADATA_FILE
    again = '`ros2 bag reindex` writes it anew'
    counts: Counter[str] = Counter()
    try:
        said = yaml.safe_load(metadata.read_bytes())['rosbag2_bagfile_information']
        names = said['relative_file_paths']
        if not names or isinstance(names, str):
            raise ValueError
        # Some recorders write whole paths, under Windows with backslashes.
        files = [path / PurePath(name.replace('\\', '/')).name for name in names]
        for topic in said.get('topics_with_message_count') or ():
            if topic['message_count'] is not None:
                counts[topic['topic_metadata']['name']] += int(topic['message_count'])
    except (yaml.YAMLError, LookupError, TypeError, ValueError, AttributeError) as error:
        problem = 'cut off, or not as rosbag2 writes it' if metadata.stat().st_size else 'empty'
        raise DataError(f'{metadata}: {problem}; {again}') from error
    if missing := [file.name for file in files if not file.is_file()]:
        raise DataError(f'{metadata}: {", ".join(missing)}: not there; {again}')
    if wrong := [file.name for file in files if not {*file.suffixes} & {*STORAGE_OF_SUFFIX}]:
        raise DataError(f'{metadata}: {", ".join(wrong)}: accepted are .mcap and .db3')
    return files, counts, str(said.get('compression_mode')).lower() == 'message'


def check_sqlite_path(path: Path) -> None:
    """Raise `DataError` for a path that rosbags, which gives it to sqlite as a URI, misreads."""
    awkward = sorted(set('?#%') & set(str(path.absolute())))
    if awkward:
        raise DataError(f'{path}: a sqlite3 bag cannot have {" ".join(awkward)} in its path')


def check_sqlite_file(path: Path) -> None:
    """Raise an error where a sqlite file is empty, cut off, or in part still in a journal."""
    with path.open('rb') as file:
        header = file.read(100)
    if not header:
        raise ValueError('empty')
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


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise errors of parsing a bag as `DataError` with its path."""
    try:
        yield
    except (DataError, MissingDependencyError):
        raise
    except Exception as error:  # Of many types: struct, sqlite3, lz4, asserts, ...
        said = in_one_line(error)
        step = next((f' ({hint})' for key, hint in _NEXT_STEP.items() if key in said), '')
        raise DataError(f'{path}: cannot be read as a bag: {said}{step}') from error
