"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from gp_ground_seg.errors import DataError


def check_writable(path: str | Path, overwrite: bool = False) -> None:
    """Refuse a target before the work for it is done.

    Raises
    ------
    DataError
        If its folder is missing, it is no regular file, or it exists and
        `overwrite` is false.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise DataError(f'{path}: the folder {target.parent} does not exist')
    if target.exists() and not target.is_file():
        raise DataError(f'{path}: is not a regular file')
    if target.exists() and not overwrite:
        raise DataError(f'{path}: exists already; --force overwrites it')


@contextlib.contextmanager
def written_whole(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file that takes the name `path` only when the block ends well.

    Raises
    ------
    DataError
        If it cannot be written.
    """
    # Of a link, the file it points to is replaced, not the link.
    target = Path(path).resolve()
    part = target.with_name(f'.{target.name}.{os.getpid()}.part')
    try:
        with part.open('xb') as file:
            yield file
        os.replace(part, target)
    except OSError as error:
        raise DataError(f'{path}: {error.strerror or error}') from error
    finally:
        # Gone already if all went well.
        part.unlink(missing_ok=True)
