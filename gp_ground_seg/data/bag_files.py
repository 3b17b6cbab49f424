"""What bags look like on disk, and the errors of reading them."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gp_ground_seg.errors import DataError, GroundSegError

BAG_SUFFIXES = ('.bag', '.mcap', '.db3')
METADATA_FILE = 'metadata.yaml'

# What rosbags says -> what to do about it.
_NEXT_STEP = {
    'end magic': 'truncated, or still being recorded; `mcap recover` saves what is there',
    'not indexed': 'truncated, or still being recorded; `rosbag reindex` saves what is there',
    'index looks damaged': 'truncated? `rosbag reindex` saves what is there',
    'malformed': 'truncated or overwritten? `sqlite3 .recover` saves what is there',
}


def is_bag(path: str | Path) -> bool:
    """Whether `path` looks like a bag: a folder with metadata.yaml, or by its suffix."""
    candidate = Path(path)
    if candidate.is_dir():
        return (candidate / METADATA_FILE).is_file()
    return candidate.suffix in BAG_SUFFIXES


def check_is_bag(path: Path) -> None:
    """Raise `DataError` with the next step if `path` cannot be a bag."""
    if not path.exists():
        raise DataError(f'{path}: no such file or folder')
    for file in path.glob('*.db3') if path.is_dir() else [path]:
        if file.suffix == '.db3':
            _check_sqlite_file(file)
    if path.is_dir() and not is_bag(path):
        files = sorted(child.name for child in path.iterdir() if child.suffix in BAG_SUFFIXES)
        hint = f'; bag files in it, to be given one by one: {", ".join(files)}' if files else ''
        raise DataError(f'{path}: not a rosbag2 folder (no {METADATA_FILE} in it){hint}')
    if not is_bag(path):
        raise DataError(
            f'{path}: not a bag; accepted are ROS 1 .bag, .mcap, .db3 and rosbag2 folders'
        )


def check_sqlite_path(path: Path) -> None:
    """Raise `DataError` for a sqlite file that would not be found under its name.

    rosbags hands the path to sqlite as a URI, where some letters end or alter
    it: another file than the one named would be opened.
    """
    awkward = sorted(set('?#%') & set(str(path.absolute())))
    if awkward:
        raise DataError(f'{path}: a sqlite3 bag cannot have {" ".join(awkward)} in its path')


def _check_sqlite_file(path: Path) -> None:
    """Raise `DataError` where part of a sqlite file is cut off, or still in a journal.

    sqlite reads what is missing from the last page as zeros, and rosbags ignores journals.
    """
    check_sqlite_path(path)
    with path.open('rb') as file:
        header = file.read(100)
    size, wanted = path.stat().st_size, _sqlite_size(header)
    if size < wanted:
        raise DataError(f'{path}: truncated, {size} bytes where its header says {wanted}')
    for ending in ('-wal', '-journal'):
        journal = path.with_name(path.name + ending)
        if journal.exists() and journal.stat().st_size > 0:
            raise DataError(
                f'{path}: was not closed, some of it is in {journal.name}; '
                f'`sqlite3 {path.name} vacuum` completes it'
            )


def _sqlite_size(header: bytes) -> int:
    """Size of the file that a sqlite header tells, 0 if it does not.

    Source: the database header in https://www.sqlite.org/fileformat.html
    """
    if len(header) < 100 or header[24:28] != header[92:96]:
        return 0
    page_size = int.from_bytes(header[16:18], 'big')
    # 65536 does not fit into the two bytes.
    page_size = 65536 if page_size == 1 else page_size
    return page_size * int.from_bytes(header[28:32], 'big')


def is_ros1_bag(path: Path) -> bool:
    """Whether a path that `check_is_bag` let pass is of ROS 1."""
    return path.suffix == '.bag' and not path.is_dir()


def open_reader(path: Path) -> Any:
    """Open reader of rosbags for a path that `check_is_bag` let pass."""
    from rosbags import rosbag1, rosbag2

    reader = rosbag1.Reader(path) if is_ros1_bag(path) else rosbag2.Reader(path)
    reader.open()
    return reader


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Name the bag in whatever goes wrong while it is parsed."""
    try:
        yield
    except GroundSegError:
        raise
    except Exception as error:
        # rosbags lets the errors of its many parsers through (struct, apsw, lz4, asserts, ...);
        # whichever it is, these bytes are not a bag it can read.
        said = in_one_line(error)
        step = next((f' ({hint})' for key, hint in _NEXT_STEP.items() if key in said), '')
        raise DataError(f'{path}: cannot be read as a bag: {said}{step}') from error


def in_one_line(error: Exception) -> str:
    """Return what an error says, or its name if it says nothing."""
    # Some of rosbags' messages quote a whole message definition.
    return textwrap.shorten(str(error), 200, placeholder=' ...') or type(error).__name__
