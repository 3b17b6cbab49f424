"""Files by path or by URL (``s3://``, ``gs://``, ...); the one module that imports fsspec.

A local file is replaced by a rename, an object by one request: neither is ever half of a new one.
"""

from __future__ import annotations

import os
import posixpath
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gp_ground_seg.core.errors import (
    DataError,
    GroundSegError,
    MissingDependencyError,
    in_one_line,
    reason_of,
    require,
)
from gp_ground_seg.data.atomic_output import PARTIAL_MARK

MAX_SCAN_BYTES = 1 << 30  # of a file: 67 million points, a hundred times a dense scan


@dataclass(frozen=True)
class UrlPath:
    """A file or folder by URL: the part of `pathlib.Path` that data sets are read with.

    Credentials and endpoints are those that fsspec finds, as in the environment. Errors are
    raised as a DataError with the URL.
    """

    url: str

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> UrlPath:
        return self if name == '.' else UrlPath(f'{self.url.rstrip("/")}/{name}')

    @property
    def name(self) -> str:
        """Last part of the path."""
        return posixpath.basename(self.url.rstrip('/'))

    @property
    def stem(self) -> str:
        """Name without its suffix."""
        return posixpath.splitext(self.name)[0]

    @property
    def suffix(self) -> str:
        """Ending of the name, as in ``.bin``."""
        return posixpath.splitext(self.name)[1]

    @property
    def parent(self) -> UrlPath:
        """Folder it is in."""
        return UrlPath(posixpath.dirname(self.url.rstrip('/')))

    def exists(self) -> bool:
        """Whether there is such a file or folder."""
        with self._open() as (system, path):
            return bool(system.exists(path))

    def is_dir(self) -> bool:
        """Whether it is a folder."""
        with self._open() as (system, path):
            return bool(system.isdir(path))

    def glob(self, pattern: str) -> list[UrlPath]:
        """Files and folders below it whose path has this form."""
        with self._open() as (system, path):
            found = system.glob(f'{path.rstrip("/")}/{pattern}')
            return [UrlPath(system.unstrip_protocol(name)) for name in found]

    def read(self, most: int) -> tuple[bytes, int]:
        """Bytes and their number; none of them if there are more than `most`."""
        with self._open() as (system, path):
            size = int(system.info(path)['size'])
            data = b'' if size > most else system.cat_file(path)
            if data and len(data) != size:
                raise DataError(f'{self.url}: {len(data)} of {size} bytes came')
            return data, size

    def write_bytes(self, data: bytes) -> None:
        """Write a file by one request: it is there as a whole or not at all."""
        with self._open() as (system, path):
            system.pipe_file(path, data)

    @contextmanager
    def _open(self) -> Iterator[tuple[Any, str]]:
        """File system, and the path in it; errors in the block become a DataError."""
        core = require('fsspec.core', 'fsspec')
        try:
            yield core.url_to_fs(self.url, use_listings_cache=False)
        except GroundSegError:
            raise
        except ImportError as error:  # of the package for this kind of URL, which fsspec names
            raise MissingDependencyError(f'{self.url}: {error}') from error
        except FileNotFoundError as error:
            raise DataError(f'{self.url}: no such file or folder') from error
        except Exception as error:  # of many types: botocore, aiohttp, google.auth, ...
            raise DataError(f'{self.url}: {in_one_line(error)}') from error


AnyPath = Path | UrlPath


def as_path(place: str | AnyPath) -> AnyPath:
    """Path, or URL if it is one."""
    if isinstance(place, str) and '://' in place:
        return UrlPath(place)
    return Path(place) if isinstance(place, str) else place


def read_bytes(path: str | AnyPath, most: int, expected: str = '') -> bytes:
    """Read a file; DataError if it cannot be read or has more than `most` bytes."""
    try:
        place = as_path(path)
        if isinstance(place, UrlPath):
            data, size = place.read(most)
        else:
            with open(place, 'rb') as file:
                size = os.fstat(file.fileno()).st_size
                # A pipe or a device has the size 0, and may have no end.
                data = b'' if size > most else file.read(size or most + 1)
    except OSError as error:
        raise DataError(f'{path}: {reason_of(error)}') from error
    if max(size, len(data)) > most:
        expected = expected or f'accepted are at most {most}'
        raise DataError(f'{path}: {max(size, len(data))} bytes, {expected}')
    return data


def write_file(path: AnyPath, data: bytes) -> None:
    """Write a file that appears, or is replaced, as a whole; DataError if it cannot be."""
    if isinstance(path, UrlPath):
        path.write_bytes(data)
        return
    try:
        # Two workers that compute the same file write under different names.
        partial = path.with_name(f'.{path.name}{PARTIAL_MARK}{uuid.uuid4().hex}')
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            partial.write_bytes(data)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f'{path}: cannot be written: {reason_of(error)}') from error
