"""Files that are read up to a limit; output that is on disk whole, or not at all.

Output never replaces what the user has not agreed to. It is flushed to disk, with the folder that
it is in, before it counts as written: a power failure leaves no empty file under its name.
"""

import errno
import fcntl
import glob
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from gp_ground_seg.core import errors
from gp_ground_seg.core.errors import DataError, PointCloudError

MAX_SCAN_BYTES = 1 << 30  # of a file: 67 million points, a hundred times a dense scan
IsKind = Callable[[Path], bool]  # whether a path is of the kind that may be replaced
PARTIAL_MARK = '.partial-'  # part of the names of hidden folders with unfinished output
_REPLACED = 'replaced'  # name that a bag has there until the one that replaces it is in its place


def read_bytes(path: str | Path, most: int, expected: str = '') -> bytes:
    """Read a file; DataError if it cannot be read or has more than `most` bytes."""
    try:
        with open(path, 'rb') as file:
            size = os.fstat(file.fileno()).st_size
            # A pipe or a device has the size 0, and may have no end.
            data = b'' if size > most else file.read(size or most + 1)
    except OSError as error:
        raise DataError(f'{path}: {errors.reason_of(error)}') from error
    if max(size, len(data)) > most:
        expected = expected or f'accepted are at most {most}'
        raise DataError(f'{path}: {max(size, len(data))} bytes, {expected}')
    if data.startswith(b'version https://git-lfs'):
        raise DataError(f'{path}: stands for the file in Git LFS: `git lfs pull` fetches it')
    return data


def changed_at(path: Path) -> int:
    """Time of the last change of a file, or of any file in a folder [ns]; 0 if it is not there."""
    try:
        return max(part.stat().st_mtime_ns for part in (path, *path.rglob('*')))
    except FileNotFoundError:
        return 0


@contextmanager
def naming(place: str | Path, what: str = '') -> Iterator[None]:
    """Raise an error in the block as a DataError that names the place, a file or message.

    Without `what`, only a PointCloudError; with it any error, which `what` introduces.
    """
    try:
        yield
    except PointCloudError as error:
        raise DataError(f'{place}: {error}') from error
    except Exception as error:  # Of many types: struct.error, zlib.error, sqlite3, lz4, ...
        if not what or isinstance(error, errors.GroundSegError):
            raise
        said = f'{type(error).__name__}: {errors.in_one_line(error)}'
        raise DataError(f'{place}: {what} ({said})') from error


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Raise an error of writing in the block as a DataError that blames this file or bag."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise DataError(f'{path}: cannot be written: {errors.reason_of(error)}') from error


def check_writable(target: str | Path, *, force: bool) -> None:
    """Raise what `staged_file` would, for a file that is written later."""
    with staged_file(target, force=force):
        pass


@contextmanager
def _opened(path: str | Path) -> Iterator[int]:
    """Open a file or folder to read it; yield its number."""
    number = os.open(path, os.O_RDONLY)
    try:
        yield number
    finally:
        os.close(number)


def flush(path: Path) -> None:
    """Have the disk hold a file, or the names in a folder, where its file system can."""
    with _opened(path) as number:
        try:
            os.fsync(number)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                raise OSError(error.errno, error.strerror, str(path)) from error


def remove_leftovers(folder: Path, name: str = '') -> None:
    """Remove unfinished output that killed runs left in a folder: of one target, or of all.

    Output of runs that are still going is locked, and stays.
    """
    for left in folder.glob(f'.{glob.escape(name) or "*"}{PARTIAL_MARK}*'):
        with suppress(OSError), _opened(left) as number:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            target = folder / left.name[1:].rpartition(PARTIAL_MARK)[0]
            if not target.exists() and (left / _REPLACED).exists():
                os.rename(left / _REPLACED, target)
            shutil.rmtree(left)


def write_file(path: Path, data: bytes, *, force: bool = True) -> None:
    """Write a file, and the folders that it is in, as `staged_file` does.

    What killed runs left of it stays: a folder of many files is searched once, by its writer.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with staged_file(path, force=force, tidies=False) as part, writing(path):
        part.write_bytes(data)


@contextmanager
def staged_file(
    target: str | Path, *, force: bool, is_kind: IsKind = Path.is_file, tidies: bool = True
) -> Iterator[Path]:
    """Yield a path to write; at the end of the block the file is renamed to `target`.

    Raises DataError if the target exists and `force` is false, is not of the kind that may be
    replaced, or cannot be written. A block that writes nothing changes nothing.
    The path has the final name, in a hidden folder beside it that goes away in the end. The folder
    is locked. One of a run that was killed is not: the next run that `tidies` removes it.
    """
    path, check = Path(target).resolve(), partial(_check, target, force, is_kind)
    if tidies:
        remove_leftovers(path.parent, path.name)
    if path.is_symlink():
        raise DataError(f'{target}: {os.strerror(errno.ELOOP)}')
    check(path)
    if not path.parent.is_dir():
        raise DataError(f'{target}: the folder {path.parent} does not exist')
    hidden = path.with_name(f'.{path.name}{PARTIAL_MARK}')
    try:
        temporary = tempfile.TemporaryDirectory(
            prefix=hidden.name, dir=path.parent, ignore_cleanup_errors=True
        )
        with temporary as folder, _opened(folder) as number:
            with suppress(OSError):  # not every file system has locks
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            product = Path(folder, path.name)
            yield product
            check(path)
            if product.exists():
                with writing(target):
                    _place(product, path)
    except OSError as error:
        if not str(error.filename).startswith(str(hidden)):
            raise  # of something else in the block
        raise DataError(f'{target}: cannot be written: {errors.reason_of(error)}') from error


def _check(target: str | Path, force: bool, is_kind: IsKind, path: Path) -> None:
    """Raise DataError if what is there may not be replaced."""
    if path.exists() and not is_kind(path):
        kind = 'file' if is_kind is Path.is_file else 'rosbag2 folder'
        raise DataError(f'{target}: is not a {kind}, not replaced; remove it yourself')
    if path.exists() and not force:
        raise DataError(f'{target}: exists already; --force replaces it')


def _place(product: Path, path: Path) -> None:
    """Flush a file or folder to disk, and give it its name."""
    for part in (*product.rglob('*'), product):
        flush(part)
    # A folder cannot be replaced in one step: the old one is renamed, and back if need be.
    aside = product.with_name(_REPLACED)
    try:
        if path.is_dir():
            os.rename(path, aside)
        os.rename(product, path)
    except BaseException:  # also that of Ctrl-C
        if aside.exists() and not path.exists():
            os.rename(aside, path)
        raise
    flush(path.parent)
