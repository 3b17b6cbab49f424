"""Output that appears whole or not at all, and never over something of the user's."""

from __future__ import annotations

import glob
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from gp_ground_seg.errors import DataError

PARTIAL_MARK = '.partial-'
"""Part of the hidden names under which unfinished output is kept."""


def leftovers(target: str | Path) -> list[Path]:
    """Unfinished output of other runs for the same target: killed ones, or still going."""
    path = Path(target).resolve()
    return sorted(path.parent.glob(f'.{glob.escape(path.name)}{PARTIAL_MARK}*'))


@contextmanager
def staged_file(target: str | Path, *, force: bool) -> Iterator[Path]:
    """Yield a path to write; the file takes the name `target` once the block ends well.

    Raises DataError if the target exists and `force` is false, is not a regular file, or cannot
    be written.
    """
    path = Path(target).resolve()

    def check() -> None:
        if path.exists() and not path.is_file():
            raise DataError(f'{target}: is not a file, not replaced')
        _refuse_existing(path, target, force)

    with _staging(path, target, check) as product:
        yield product
        check()
        os.replace(product, path)


@contextmanager
def staged_folder(
    target: str | Path, *, force: bool, is_ours: Callable[[Path], bool]
) -> Iterator[Path]:
    """Yield a folder to create; it takes the name `target` once the block ends well.

    With `force` a folder of that name is replaced, if `is_ours` says of it that it holds nothing
    but such output. Raises DataError if it may not be replaced or cannot be written.
    """
    path = Path(target).resolve()

    def check() -> None:
        _refuse_existing(path, target, force)
        if path.exists() and not is_ours(path):
            raise DataError(f'{target}: is not a rosbag2 folder, not replaced; remove it yourself')

    with _staging(path, target, check) as product:
        yield product
        check()
        # A folder cannot be replaced in one step: the old one is renamed, and back if need be.
        aside = product.with_name('replaced')
        existed = path.exists()
        if existed:
            os.rename(path, aside)
        try:
            os.rename(product, path)
        except OSError:
            if existed:
                os.rename(aside, path)
            raise


@contextmanager
def staged_files(folder: str | Path, names: Sequence[str], *, force: bool) -> Iterator[Path]:
    """Yield a folder to write the files `names` into; all appear in `folder` at the end.

    A folder that does not exist yet appears at once; into an existing one the
    files are moved one by one, each of them whole, beside what is there. Raises DataError if one
    of the files exists and `force` is false, or they cannot be written.
    """
    path = Path(folder).resolve()

    def check() -> None:
        if path.exists() and not path.is_dir():
            raise DataError(f'{folder}: is a file, must be a folder')
        existing = [name for name in names if (path / name).exists()]
        if existing and not force:
            raise DataError(
                f'{Path(folder) / existing[0]}: exists already ({len(existing)} of {len(names)} '
                'files to write do); --force replaces them'
            )

    with _staging(path, folder, check) as product:
        product.mkdir()
        yield product
        check()
        if not path.exists():
            os.rename(product, path)
            return
        for name in names:
            os.replace(product / name, path / name)


def _refuse_existing(path: Path, shown: str | Path, force: bool) -> None:
    if path.exists() and not force:
        raise DataError(f'{shown}: exists already; --force replaces it')


@contextmanager
def _staging(path: Path, shown: str | Path, check: Callable[[], None]) -> Iterator[Path]:
    """Path with the final name, in a hidden folder beside it that goes away in the end."""
    check()
    if not path.parent.is_dir():
        raise DataError(f'{shown}: the folder {path.parent} does not exist')
    folder: Path | None = None
    try:
        folder = Path(tempfile.mkdtemp(prefix=f'.{path.name}{PARTIAL_MARK}', dir=path.parent))
        yield folder / path.name
    except OSError as error:
        raise DataError(f'{shown}: cannot be written: {error.strerror or error}') from error
    finally:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
