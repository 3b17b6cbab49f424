"""Writing rosbag2 bags that appear whole or not at all."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from gp_ground_seg.data.atomic_output import staged_file, staged_folder
from gp_ground_seg.data.bag_files import METADATA_FILE, check_sqlite_path
from gp_ground_seg.data.rosbags_support import BagTopic, require_rosbags
from gp_ground_seg.errors import DataError

SUFFIX_OF_STORAGE = {'mcap': '.mcap', 'sqlite3': '.db3'}
STORAGE_OF_SUFFIX = {suffix: storage for storage, suffix in SUFFIX_OF_STORAGE.items()}
DEFAULT_STORAGE = 'mcap'
FORMAT_VERSION = 9
"""Of rosbag2's metadata; what Jazzy writes."""

_BAG_FOLDER_SUFFIXES = ('.mcap', '.db3', '.db3-shm', '.db3-wal', '.zstd', '.zst')


def resolve_storage(path: str | Path, wanted: str | None = None) -> str:
    """Storage that a bag at `path` gets.

    Parameters
    ----------
    path : str or Path
        Ends in .mcap or .db3 for a single file; anything else is a folder.
    wanted : {'mcap', 'sqlite3'}, optional
        Asked for; by default what the suffix says, MCAP in a folder.

    Raises
    ------
    DataError
        If the two contradict, or the storage cannot hold that path.
    """
    suffix = Path(path).suffix
    if suffix == '.bag':
        raise DataError(f'{path}: only ROS 2 bags are written; use .mcap, .db3 or a folder name')
    implied = STORAGE_OF_SUFFIX.get(suffix)
    if wanted is not None and implied is not None and wanted != implied:
        raise DataError(
            f'{path}: ends in {suffix}, which is not {wanted} ({SUFFIX_OF_STORAGE[wanted]})'
        )
    storage = wanted or implied or DEFAULT_STORAGE
    if storage == 'sqlite3':
        check_sqlite_path(Path(path))
    return storage


class BagWriter:
    """A new rosbag2 bag; use it in a ``with`` statement.

    It is written under a hidden name beside its final place and takes its name
    only when the block ends well. A killed run leaves the hidden one behind.

    Parameters
    ----------
    path : str or Path
        A folder as ``ros2 bag record -o`` makes; or, if it ends in ``.mcap`` or
        ``.db3``, that single file, which ``ros2 bag play`` and Foxglove take too.
    storage : {'mcap', 'sqlite3'}, optional
        See `resolve_storage`.
    force : bool
        Whether a bag of that name is replaced, once the new one is complete.

    Raises
    ------
    DataError
        If the path is taken, or cannot be written.
    MissingDependencyError
        If rosbags is not installed.
    """

    def __init__(
        self, path: str | Path, *, storage: str | None = None, force: bool = False
    ) -> None:
        require_rosbags()
        self.path = Path(path)
        self.storage = resolve_storage(path, storage)
        self._single_file = self.path.suffix in STORAGE_OF_SUFFIX
        self._staging: AbstractContextManager[Path] = (
            staged_file(path, force=force)
            if self._single_file
            else staged_folder(path, force=force, is_ours=is_bag_folder, kind='a rosbag2 folder')
        )
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        """Create the hidden bag."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        self._product = self._staging.__enter__()
        self._folder = self._product
        if self._single_file:
            # rosbags writes folders; the one file in it is named after the folder.
            self._folder = self._product.parent / 'bag' / self._product.stem
        try:
            with self._writing():
                plugin = StoragePlugin[self.storage.upper()]
                self._writer = Writer(self._folder, version=FORMAT_VERSION, storage_plugin=plugin)
                self._writer.__enter__()
        except BaseException as error:
            self._staging.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the bag its name, or remove it after an error."""
        try:
            with self._writing():
                self._writer.__exit__(kind, error, trace)
                if kind is None and self._single_file:
                    suffix = SUFFIX_OF_STORAGE[self.storage]
                    os.rename(self._folder / f'{self._folder.name}{suffix}', self._product)
        except BaseException as failure:
            self._staging.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._staging.__exit__(kind, error, trace)

    def add_topic(self, topic: BagTopic) -> None:
        """Declare a topic; must come before its first message.

        Raises
        ------
        DataError
            If there is one of that name, or the disk is full.
        """
        if topic.name in self._connections:
            raise DataError(f'{self.path}: topic {topic.name} twice')
        with self._writing():
            self._connections[topic.name] = self._writer.add_connection(
                topic.name,
                topic.msgtype,
                msgdef=topic.definition,
                rihs01=topic.type_hash,
                serialization_format=topic.encoding,
                offered_qos_profiles=topic.qos,
            )

    def write(self, topic: str, time: int, raw: bytes | memoryview) -> None:
        """Append one message.

        Parameters
        ----------
        topic : str
            A declared topic.
        time : int
            Recorded time [ns].
        raw : bytes
            The message as CDR.

        Raises
        ------
        DataError
            If it cannot be written, as when the disk is full.
        """
        with self._writing():
            self._writer.write(self._connections[topic], time, raw)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise DataError(
                f'{self.path}: cannot be written: {error.strerror or error}'
            ) from error
        except sqlite3.Error as error:
            raise DataError(f'{self.path}: cannot be written: {error}') from error


def is_bag_folder(path: Path) -> bool:
    """Whether a folder holds a rosbag2 bag and nothing else."""
    if not (path / METADATA_FILE).is_file():
        return False
    return all(
        child.is_file() and (child.name == METADATA_FILE or child.suffix in _BAG_FOLDER_SUFFIXES)
        for child in path.iterdir()
    )
