"""Files that are read up to a limit, and written whole: replaced by a rename."""

from __future__ import annotations

import os
import stat
import uuid
from pathlib import Path

from gp_ground_seg.core.errors import DataError, reason_of
from gp_ground_seg.data.atomic_output import PARTIAL_MARK

MAX_SCAN_BYTES = 1 << 30  # of a file: 67 million points, a hundred times a dense scan


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


def write_file(path: Path, data: bytes) -> None:
    """Write a file that appears, or is replaced, as a whole; DataError if it cannot be."""
    try:
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
    except OSError as error:
        raise DataError(f'{path}: cannot be written: {reason_of(error)}') from error
