"""Files by path or by URL (``s3://``, ``gs://``, ...); the one module that imports fsspec.

A local file is replaced by a rename, an object by one request: neither is ever half of a new one.
"""

from __future__ import annotations

import glob
import hashlib
import os
import posixpath
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gp_ground_seg.core.errors import (
    DataError,
    GroundSegError,
    MissingDependencyError,
    PointCloudError,
    in_one_line,
    reason_of,
    require,
)
from gp_ground_seg.data.atomic_output import PARTIAL_MARK

MAX_SCAN_BYTES = 1 << 30  # of a file: 67 million points, a hundred times a dense scan
URL_SECONDS = 60.0
"""A server has this time for an answer, and as long again for each of `_BYTES_IN_TIME`."""
_BYTES_IN_TIME = 1 << 24
# By these names file systems give the version or the time of a file, the surest first.
_TIMES = ('ETag', 'etag', 'LastModified', 'last_modified', 'Last-Modified', 'mtime', 'created')
MAX_UNPACKED_BYTES = 1 << 27  # of packed data, unless these are at least half of it
MAX_POINTS = 1 << 22  # of a cloud, unless its file has 12 bytes for each: x, y, z
MAX_NUMBERS = 1000  # of a point


@dataclass(frozen=True)
class UrlPath:
    """A file or folder by URL: the part of `pathlib.Path` that data sets are read with.

    Credentials and endpoints are those that fsspec finds, as in the environment. Errors are
    raised as a DataError with the URL, as are answers that take longer than `URL_SECONDS`.
    """

    url: str
    _info: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

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
        return bool(self._ask('exists'))

    def is_dir(self) -> bool:
        """Whether it is a folder."""
        return bool(self._ask('isdir'))

    def glob(self, pattern: str) -> list[UrlPath]:
        """Files and folders below it whose path has this form."""
        if not self.exists():  # a server that does not answer is noticed here, and not below
            return []
        with self._open() as (system, path):
            whole = f'{glob.escape(path.rstrip("/"))}/{pattern}'
            # A listing is many answers.
            found = system.glob(whole, detail=True, **_limit(system, 10.0 * URL_SECONDS))
            return [UrlPath(system.unstrip_protocol(name), info) for name, info in found.items()]

    def stamp(self) -> tuple[int, str]:
        """Size and version of a file, see `stamp`."""
        listed = self._info.get('size') is not None and _version(self._info)
        info = self._info if listed else self._ask('info')
        if info.get('size') is not None and _version(info):
            return int(info['size']), _version(info)
        data = read_bytes(self, MAX_SCAN_BYTES)
        return len(data), hashlib.sha256(data).hexdigest()

    def read(self, most: int) -> tuple[bytes, int]:
        """Bytes and their number; none of them if more than `most` are announced."""
        size = self._ask('info').get('size')  # None where the server does not say it
        if size is not None and size > most:
            return b'', int(size)
        with self._open() as (system, path):
            limit = most if size is None else int(size)
            data = _body(system, path, limit, _seconds(int(size or 0)))
        if size is not None and len(data) != size:
            came = f'{len(data)} of' if len(data) < size else 'more than'
            raise DataError(f'{self.url}: {came} {size} bytes came')
        return data, len(data)

    def write_bytes(self, data: bytes) -> None:
        """Write a file by one request: it is there as a whole or not at all."""
        self._ask('pipe_file', data, n_bytes=len(data))

    def _ask(self, question: str, *more: Any, n_bytes: int = 0) -> Any:
        """Ask the file system about this path; `question` is the name of a method of fsspec."""
        with self._open() as (system, path):
            return getattr(system, question)(path, *more, **_limit(system, _seconds(n_bytes)))

    @contextmanager
    def _open(self) -> Iterator[tuple[Any, str]]:
        """File system, and the path in it; errors in the block become a DataError."""
        core = require('fsspec.core', 'fsspec')
        too_slow = require('fsspec.exceptions', 'fsspec').FSTimeoutError
        try:
            yield core.url_to_fs(self.url, use_listings_cache=False)
        except GroundSegError:
            raise
        except ImportError as error:  # of the package for this kind of URL, which fsspec names
            raise MissingDependencyError(f'{self.url}: {error}') from error
        except FileNotFoundError as error:
            raise DataError(f'{self.url}: no such file or folder') from error
        except too_slow as error:
            raise DataError(f'{self.url}: no answer, or not all of it, in time') from error
        except Exception as error:  # of many types: botocore, aiohttp, google.auth, ...
            raise DataError(f'{self.url}: {in_one_line(error)}') from error


def _version(info: dict[str, Any]) -> str:
    return next((str(info[name]) for name in _TIMES if info.get(name)), '')


def _seconds(n_bytes: int) -> float:
    return URL_SECONDS * (1 + n_bytes // _BYTES_IN_TIME)


def _limit(system: Any, seconds: float) -> dict[str, float]:
    """Arguments that limit the time of a method; file systems that are not async have none."""
    is_async = isinstance(system, require('fsspec.asyn', 'fsspec').AsyncFileSystem)
    return {'timeout': seconds} if is_async else {}


def _body(system: Any, path: str, most: int, seconds: float) -> bytes:
    """Content of a file, at most one byte more than `most`, however much is sent."""

    async def read() -> bytes:
        file, data = await system.open_async(path, 'rb', size=most), bytearray()
        try:
            while len(data) <= most and (part := await file.read(most + 1 - len(data))):
                data += part
        finally:
            await file.close()
        return bytes(data)

    limit = _limit(system, seconds)
    if limit:
        try:
            found: bytes = require('fsspec.asyn', 'fsspec').sync(system.loop, read, **limit)
            return found
        except NotImplementedError:  # a system without streams
            pass
    return bytes(system.cat_file(path, 0, most + 1, **limit))


def check_unpacked(size: int, packed: int) -> None:
    """Raise PointCloudError if `packed` bytes become more than are accepted (1 kB may be 1 GB)."""
    most = max(MAX_UNPACKED_BYTES, 2 * packed)
    if size > most:
        raise PointCloudError(f'{packed} bytes unpack to {size}, accepted are at most {most}')


def check_points(n_points: int, n_numbers: int, packed: int) -> None:
    """Raise PointCloudError if a cloud is larger than accepted in a file of `packed` bytes.

    Each of its points, which may be none, has `n_numbers` numbers.
    """
    most = max(MAX_POINTS, packed // 12)
    if n_points > most:
        raise PointCloudError(f'{n_points} points, accepted are at most {most} in {packed} bytes')
    if n_numbers > MAX_NUMBERS:
        raise PointCloudError(f'{n_numbers} numbers per point, accepted are at most {MAX_NUMBERS}')


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


def stamp(path: AnyPath) -> tuple[int, str]:
    """Size [bytes] and time of the last change of a file; of a folder, of all that is in it.

    By URL it may be the version that the server gives, or, where it gives neither, a digest of the
    content. What is not there has the size -1.
    """
    if isinstance(path, UrlPath):
        return path.stamp()
    try:
        parts = [part.stat() for part in (path, *path.rglob('*'))]
    except FileNotFoundError:
        return -1, ''
    files = [part for part in parts if not stat.S_ISDIR(part.st_mode)]
    return sum(f.st_size for f in files), str(max(part.st_mtime_ns for part in parts))


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
