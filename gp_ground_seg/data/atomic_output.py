"""Output that appears whole or not at all, and never over something of the user's."""

from __future__ import annotations

import errno
import glob
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

from gp_ground_seg.core.errors import DataError, reason_of
from gp_ground_seg.data.bag_files import is_bag_folder

PARTIAL_MARK = '.partial-'  # part of the hidden names under which unfinished output is kept


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
    try:
        with tempfile.TemporaryDirectory(
            prefix=f'.{path.name}{PARTIAL_MARK}', dir=path.parent, ignore_cleanup_errors=True
        ) as folder:
            product = Path(folder, path.name)
            yield product
            check(path)
            place(product, path)
    except OSError as error:
        name, hidden = error.filename, path.with_name(f'.{path.name}{PARTIAL_MARK}')
        if isinstance(name, str) and not name.startswith(str(hidden)):
            raise  # of something that was read
        raise DataError(f'{target}: cannot be written: {reason_of(error)}') from error
