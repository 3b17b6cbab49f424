"""Files that are read up to a limit; output that is on disk whole, or not at all.

Output never replaces what the user has not agreed to. It is flushed to disk, with the folder that
it is in, before it counts as written: a power failure leaves no empty file under its name.
"""

from __future__ import annotations

import errno
import glob
import os
import sqlite3
import stat
import tempfile
import uuid
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

from gp_ground_seg.core.errors import DataError, reason_of
from gp_ground_seg.data.bag_files import is_bag_folder

MAX_SCAN_BYTES = 1 << 30  # of a file: 67 million points, a hundred times a dense scan
PARTIAL_MARK = '.partial-'  # part of the hidden names under which unfinished output is kept


def read_bytes(path: str | Path, most: int, expected: str = '') -> bytes:
    """Read a file; DataError if it cannot be read or has more than `most` bytes."""
    try:
        with open(path, 'rb') as file:
            size = os.fstat(file.fileno()).st_size
            # A pipe or a device has the size 0, and may have no end.
            data = b'' if size > most else file.read(size or most + 1)
    except OSError as error:
        raise DataError(f'{path}: {reason_of(error)}') from error
    if max(size, len(data)) > most:
        expected = expected or f'accepted are at most {most}'
        raise DataError(f'{path}: {max(size, len(data))} bytes, {expected}')
    return data


def stamp(path: Path) -> tuple[int, str]:
    """Size [bytes] and time of the last change of a file; of a folder, of all that is in it.

    What is not there has the size -1.
    """
    try:
        parts = [part.stat() for part in (path, *path.rglob('*'))]
    except FileNotFoundError:
        return -1, ''
    files = [part for part in parts if not stat.S_ISDIR(part.st_mode)]
    return sum(f.st_size for f in files), str(max(part.st_mtime_ns for part in parts))


def checksum(path: Path) -> str:
    """CRC-32 of a file; of a folder, of the files in it, in the order of their names."""
    crc = 0
    for part in sorted(path.rglob('*')) if path.is_dir() else [path]:
        with open(part, 'rb') as file:
            while data := file.read(1 << 20):
                crc = zlib.crc32(data, crc)
    return f'{crc:08x}'


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Raise an error of writing in the block as a DataError that blames this file or bag."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise DataError(f'{path}: cannot be written: {reason_of(error)}') from error


def flush(path: Path) -> None:
    """Have the disk hold a file, or the names in a folder, where its file system can."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        os.close(number)


def write_file(path: Path, data: bytes) -> None:
    """Write a file that appears, or is replaced, as a whole; DataError if it cannot be.

    Its folder is not flushed yet.
    """
    with writing(path):
        # Two workers that compute the same file write under different names.
        partial = path.with_name(f'.{path.name}{PARTIAL_MARK}{uuid.uuid4().hex}')
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(partial, 'wb') as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)


def leftovers(target: str | Path) -> list[Path]:
    """Unfinished output of other runs for the same target: killed ones, or still going."""
    path = Path(target).resolve()
    return sorted(path.parent.glob(f'.{glob.escape(path.name)}{PARTIAL_MARK}*'))


def staged_file(target: str | Path, *, force: bool) -> AbstractContextManager[Path]:
    """Return a path to write, for a ``with`` block; at its end the file is renamed to `target`.

    The block raises DataError if the target exists and `force` is false, is not a regular file,
    or cannot be written.
    """
    return _staged(target, partial(_check_file, target, force), os.replace)


def check_writable(target: str | Path, *, force: bool) -> None:
    """Raise what `staged_file` would, for a file that is written later; write nothing."""
    with _staged(target, partial(_check_file, target, force), lambda _product, _path: None):
        pass


def staged_bag_folder(target: str | Path, *, force: bool) -> AbstractContextManager[Path]:
    """Return the path of a folder to create, as `staged_file`; `force` replaces a rosbag2 only."""

    def check(path: Path) -> None:
        _refuse_existing(path, target, force)
        if path.exists() and not is_bag_folder(path):
            raise DataError(f'{target}: is not a rosbag2 folder, not replaced; remove it yourself')

    def place(product: Path, path: Path) -> None:
        # A folder cannot be replaced in one step: the old one is renamed, and back if need be.
        aside = product.with_name('replaced')
        try:
            if path.exists():
                os.rename(path, aside)
            os.rename(product, path)
        except BaseException:  # also that of Ctrl-C
            if aside.exists() and not path.exists():
                os.rename(aside, path)
            raise

    return _staged(target, check, place)


@contextmanager
def staged_files(folder: str | Path, names: Sequence[str], *, force: bool) -> Iterator[Path]:
    """Yield a folder to write the files `names` into; all appear in `folder` at the end.

    A folder that does not exist yet appears at once; into an existing one the
    files are moved one by one, each complete, beside the files that are there. Until then they
    are in a hidden folder, the parent of the yielded one. Raises DataError if one of the files
    exists and `force` is false, or they cannot be written.
    """

    def check(path: Path) -> None:
        if path.exists() and not path.is_dir():
            raise DataError(f'{folder}: is a file, must be a folder')
        existing = [name for name in names if (path / name).exists()]
        if existing and not force:
            raise DataError(
                f'{Path(folder) / existing[0]}: exists already ({len(existing)} of {len(names)} '
                'files to write do); --force replaces them'
            )

    def place(product: Path, path: Path) -> None:
        if not path.exists():
            os.rename(product, path)
            return
        for name in names:
            os.replace(product / name, path / name)

    with _staged(folder, check, place) as product:
        product.mkdir()
        yield product


def _check_file(target: str | Path, force: bool, path: Path) -> None:
    if path.exists() and not path.is_file():
        raise DataError(f'{target}: is not a file, not replaced')
    _refuse_existing(path, target, force)


def _refuse_existing(path: Path, shown: str | Path, force: bool) -> None:
    if path.exists() and not force:
        raise DataError(f'{shown}: exists already; --force replaces it')


@contextmanager
def _staged(
    target: str | Path, check: Callable[[Path], None], place: Callable[[Path, Path], None]
) -> Iterator[Path]:
    """Path with the final name, in a hidden folder beside it that goes away in the end."""
    path = Path(target).resolve()
    if path.is_symlink():
        raise DataError(f'{target}: {os.strerror(errno.ELOOP)}')
    check(path)
    if not path.parent.is_dir():
        raise DataError(f'{target}: the folder {path.parent} does not exist')
    hidden = path.with_name(f'.{path.name}{PARTIAL_MARK}')
    try:
        with tempfile.TemporaryDirectory(
            prefix=hidden.name, dir=path.parent, ignore_cleanup_errors=True
        ) as folder:
            product = Path(folder, path.name)
            yield product
            check(path)
            with writing(target):
                for part in (*product.rglob('*'), product) if product.exists() else ():
                    flush(part)
                place(product, path)
                flush(path.parent)
    except OSError as error:
        if not str(error.filename).startswith(str(hidden)):
            raise  # of something else in the block
        raise DataError(f'{target}: cannot be written: {reason_of(error)}') from error
    except DataError as error:
        if str(hidden) not in str(error):
            raise
        raise DataError(str(error).replace(str(product), str(target))) from error
