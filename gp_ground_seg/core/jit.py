"""The one policy for code compiled with numba, which is optional, and for keeping it on disk.

numba keeps compiled code itself (``cache=True``), here in a folder of the user that is named by
our sources and by versions: code of other sources is never read. Each function has a checksum of
its files: what is damaged, as after a power cut, is compiled again. Of several processes one
compiles a function, and the others wait for its files.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import glob
import hashlib
import importlib.util
import logging
import os
import stat
import sys
import time
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np

from gp_ground_seg.core.errors import log_once

# Ubuntu 24.04 has no package of numba. Its import takes most of a second: it waits until something
# is to be compiled.
HAVE_NUMBA = importlib.util.find_spec('numba') is not None
JIT_ENABLED = HAVE_NUMBA and os.environ.get('NUMBA_DISABLE_JIT', '0') in ('', '0')
"""Whether functions are compiled, rather than left plain Python."""

_Function = TypeVar('_Function', bound=Callable[..., Any])
_CORE = Path(__file__).parent
_entry_points: list[Any] = []
_shared: list[Callable[..., Any]] = []
_ALL, _CHECKSUM, _LOCK = 'all', '.sha256', '.lock'
_kept: set[str] = set()  # checksums of the functions that this process has read or written
_turn: IO[bytes] | None = None  # the file that is locked while a function is compiled
_patience = 120.0  # longest wait for others, in all [s]: one may be suspended


def shared(function: _Function) -> _Function:
    """Let compiled code call a plain function by its name.

    It stays plain Python, as importing numba takes most of a second: numpy code calls it with
    arrays, or loops in it run uncompiled.
    """
    _shared.append(function)
    return function


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Return `a` where the condition holds, else `b`; of numbers in compiled code."""
    return np.where(condition, a, b)


def compiled_form(
    plain: Callable[..., Any],
    *,
    fastmath: bool = False,
    single: Callable[..., Any] | None = None,
) -> Callable[[_Function], _Function]:
    """Return a decorator for what runs in compiled code where it calls `plain`.

    For functions that are a call of numpy to arrays, and a loop or a branch to compiled code.
    Where the first argument is of single precision, `single` runs instead, if there is one.
    """

    def decorate(function: _Function) -> _Function:
        if JIT_ENABLED:
            from numba import types
            from numba.extending import overload

            def choose_form(*arguments: Any) -> Callable[..., Any]:
                return single if single and arguments[0] is types.float32 else function

            overload(plain, jit_options=_options(fastmath), strict=False)(choose_form)
        return function

    return decorate


def _options(fastmath: bool = False) -> dict[str, Any]:
    # No function is handed to C, and a wrapper for it takes a tenth of the time to compile.
    options: dict[str, Any] = {'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True}
    if fastmath:
        options['fastmath'] = {'reassoc', 'contract', 'nsz'}
    return options


def jit(
    *, fastmath: bool = False, entry: bool = False, part: bool = False
) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles a function where numba is installed.

    Compiled functions release the interpreter's lock. Only `entry` functions are compiled for
    calls from Python.

    Parameters
    ----------
    fastmath : bool
        Let sums be taken in any order, so that they use vector instructions; NaN and infinity
        keep their meaning. Only for functions that write to no array: where arrays that are
        written lie close to those that are read, the program leaves the vector instructions
        aside, and the sums would depend on where the arrays happen to be.
    entry : bool
        Whether it is called from Python: its code, with all that it calls, is kept on disk. It
        returns numbers, or nothing: numba runs Python to return arrays and named tuples, where
        Ctrl-C ends in a SystemError or a crash.
    part : bool
        Whether it is called in one place, as a part of a kernel: compiled there, and not by itself
        first. Of many lines that takes longer.
    """

    def decorate(function: _Function) -> _Function:
        if not JIT_ENABLED:
            return function
        import numba

        while _shared:
            plain = _shared.pop()
            compiled_form(plain)(plain)
        if part:
            inlined: _Function = numba.njit(inline='always')(function)
            return inlined
        if not entry:
            # Without a wrapper for Python, which takes a tenth of the time to compile: there the
            # function stays plain.
            return compiled_form(function, fastmath=fastmath)(function)
        compiled: _Function = _njit_kept(function)
        _entry_points.append(compiled)
        return compiled

    return decorate


def _njit_kept(function: Callable[..., Any]) -> Any:
    """Compile `function` with its code kept on disk, if there is a folder to trust for it."""
    import numba

    folder = code_folder()
    if folder is None:
        return numba.njit(**_options())(function)
    # numba reads this once, here. Without it, code would lie beside our sources.
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
    try:
        kept = numba.njit(**_options(), cache=True)(function)
    finally:
        numba.config.CACHE_DIR = before
    place = Path(kept.stats.cache_path)
    if folder not in place.parents:
        _log_not_kept(f'{folder} cannot be written to')
        return numba.njit(**_options())(function)
    # numba has no public hook here; a numba without these names keeps code without checksums.
    cache: Any = getattr(kept, '_cache', None)
    module = Path(function.__code__.co_filename).stem
    if hasattr(cache, 'load_overload') and hasattr(cache, 'save_overload'):
        checksum = place / f'{module}.{function.__qualname__}{_CHECKSUM}'
        cache.load_overload = functools.partial(_load, cache.load_overload, folder, checksum)
        cache.save_overload = functools.partial(_save, cache.save_overload, folder, checksum)
    return kept


def _load(load: Callable[..., Any], folder: Path, checksum: Path, *arguments: Any) -> Any:
    """Let numba `load` code if its files are whole; None where it has to compile."""
    with contextlib.suppress(OSError):
        if not _is_whole(checksum):
            _begin_turn(checksum)
            if not _is_whole(checksum):
                for path in _files_of(checksum):
                    path.unlink(missing_ok=True)
        if (found := load(*arguments)) is not None:
            _list(folder, checksum)
            _end_turn()  # another process has compiled it meanwhile
            return found
    _begin_turn(checksum)
    log_once(logging.WARNING, 'compiling once for this processor, which takes 20 to 60 s')
    return None


def _save(save: Callable[..., Any], folder: Path, checksum: Path, *arguments: Any) -> None:
    """Let numba `save` what it has compiled; a full disk is a warning."""
    try:
        save(*arguments)
        checksum.write_bytes(_digest_of(_files_of(checksum)))
        _list(folder, checksum)
    except OSError as error:
        _log_not_kept(error)
    finally:
        _end_turn()


def _files_of(checksum: Path) -> list[Path]:
    """Return the files in which numba keeps the code of a function."""
    name = glob.escape(checksum.name.removesuffix(_CHECKSUM))
    return [*checksum.parent.glob(f'{name}-*.nb[ic]')]


def _digest_of(files: Iterable[Path], begin: str = '') -> bytes:
    digest = hashlib.sha256(begin.encode())
    for path in sorted(files):
        digest.update(path.name.encode() + b'\0' + path.read_bytes())
    return digest.digest()


def _is_whole(checksum: Path) -> bool:
    """Whether the files of a function are those that were written."""
    try:
        return checksum.read_bytes() == _digest_of(_files_of(checksum))
    except OSError:
        return False


def _list(folder: Path, checksum: Path) -> None:
    """Write the list of checksums that a frame needs, once each function has one."""
    _kept.add(str(checksum.relative_to(folder)))
    if len(_kept) == len(_entry_points) and not is_code_kept():
        with contextlib.suppress(OSError):
            (folder / _ALL).write_text('\n'.join(sorted(_kept)))


def _begin_turn(checksum: Path) -> None:
    """Wait until no other process compiles this function, or the patience is at an end."""
    global _turn, _patience
    with contextlib.suppress(OSError):  # the disk is full, or has no locks
        _turn = _turn or checksum.with_suffix(_LOCK).open('ab')
        while _patience > 0.0:
            try:
                return fcntl.flock(_turn, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                time.sleep(0.05)
                _patience -= 0.05


def _end_turn() -> None:
    """Let another process compile the function."""
    global _turn
    if _turn is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(_turn, fcntl.LOCK_UN)  # a forked process may have it open
        _turn.close()
        _turn = None


def _log_not_kept(reason: object) -> None:
    log_once(
        logging.WARNING,
        'compiled code is not kept on disk (%s): every start compiles, which takes 20 to 60 s; '
        'set NUMBA_CACHE_DIR to a folder of your own',
        reason,
    )


@functools.cache
def code_folder() -> Path | None:
    """Return the folder where compiled code is kept; None where there is none to trust.

    It lies in ``NUMBA_CACHE_DIR``, else in the user's cache folder.
    """
    if not JIT_ENABLED:
        return None
    chosen = os.environ.get('NUMBA_CACHE_DIR') or os.environ.get('XDG_CACHE_HOME') or '~/.cache'
    try:
        folder = Path(chosen).expanduser() / 'gp_ground_seg' / _digest()
        if not folder.is_absolute():
            raise PermissionError(f'{chosen} is no absolute path')
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder = folder.resolve()
        _require_private(folder)
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home
        _log_not_kept(error)
        return None
    return folder


def _require_private(folder: Path) -> None:
    """Raise PermissionError if another user could put code into `folder`."""
    if folder.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise PermissionError(f'others can open {folder}: chmod 700')
    for path in (folder, *folder.parents):
        status = path.stat()
        if status.st_uid not in (0, os.getuid()):
            raise PermissionError(f'{path} belongs to another user')
        # Of a sticky folder, such as /tmp, only the owner of an entry can replace it.
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            raise PermissionError(f'others can write to {path}')


def _digest() -> str:
    """Name of what the code was compiled from: sources, where they lie, and versions."""
    versions = [sys.version, np.__version__, *map(metadata.version, ('numba', 'llvmlite'))]
    return _digest_of(_CORE.rglob('*.py'), '\n'.join([str(_CORE), *versions])).hex()[:16]


def has_to_compile() -> bool:
    """Whether the first frame in compiled code would take long."""
    return JIT_ENABLED and not is_code_kept()


def is_code_kept() -> bool:
    """Whether all code that a frame needs lies on disk, whole."""
    folder = code_folder()
    if folder is None:
        return False
    try:
        names = (folder / _ALL).read_text().splitlines()
    except (OSError, UnicodeError):
        return False
    return bool(names) and all(_is_whole(folder / name) for name in names)
