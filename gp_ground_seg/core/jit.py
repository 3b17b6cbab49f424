"""The one policy for code compiled with numba, which is optional, and for keeping it on disk.

numba says what is to be kept (``cache=True``), and we where: in a folder of the user that is named
by our sources and by versions, so that code of other sources is never read. Each function has a
file that begins with its checksum: what is damaged, as after a power cut, is compiled again. Of
several processes one compiles a function, and the others wait for its file.
"""

import contextlib
import fcntl
import functools
import hashlib
import importlib.util
import logging
import os
import pickle
import stat
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np

from gp_ground_seg.core.errors import log_once

DURATION = 'one to two minutes'  # of compiling all, in one process or two

# Ubuntu 24.04 has no package of numba. Its import takes most of a second: it waits until something
# is to be compiled.
HAVE_NUMBA = importlib.util.find_spec('numba') is not None
JIT_ENABLED = HAVE_NUMBA and os.environ.get('NUMBA_DISABLE_JIT', '0') in ('', '0')
"""Whether functions are compiled, rather than left plain Python."""

_Function = TypeVar('_Function', bound=Callable[..., Any])
_CORE = Path(__file__).parent
_entry_points: list[Any] = []
_shared: list[Callable[..., Any]] = []
_ALL, _CHECKSUM_SIZE = 'all', hashlib.sha256().digest_size
_kept: set[str] = set()  # files of the functions that this process has read or written
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
    plain: Callable[..., Any], *, fastmath: bool = False, single: Callable[..., Any] | None = None
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
    if folder not in Path(kept.stats.cache_path).parents:
        _log_not_kept(f'{folder} cannot be written to')
        return numba.njit(**_options())(function)
    # numba has no public hook here; one without these names keeps code in files of its own.
    cache: Any = getattr(kept, '_cache', None)
    if hasattr(cache, '_cache_file'):
        name = f'{function.__module__}.{function.__qualname__}.code'
        cache._cache_file = _CodeFile(folder / name)
    return kept


class _CodeFile:
    """Code of one function, for each type of its arguments, in place of the files of numba."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock: IO[bytes] | None = None  # held while the function is compiled

    def load(self, key: object) -> Any:
        """Return code, or None where it has to be compiled; then `save` follows."""
        if (code := self._read().get(key)) is None:
            self._begin_turn()
            if (code := self._read().get(key)) is None:
                log_once(
                    logging.WARNING, f'compiling once for this processor, which takes {DURATION}'
                )
                return None
            self._end_turn()  # another process has compiled it meanwhile
        _list(self._path)
        return code

    def save(self, key: object, code: object) -> None:
        """Write what was compiled; a full disk is a warning."""
        try:
            content = pickle.dumps({**self._read(), key: code})
            self._path.write_bytes(hashlib.sha256(content).digest() + content)
            _list(self._path)
        except (OSError, pickle.PickleError, TypeError, AttributeError) as error:
            # The disk, or a version of numba whose code cannot be pickled.
            _log_not_kept(error)
        finally:
            self._end_turn()

    def _read(self) -> dict[object, Any]:
        content = _read_whole(self._path)
        return pickle.loads(content) if content else {}

    def _begin_turn(self) -> None:
        """Wait until no other process compiles the function, or the patience is at an end."""
        global _patience
        with contextlib.suppress(OSError):  # the disk is full, or has no locks
            self._lock = self._lock or self._path.with_suffix('.lock').open('ab')
            while _patience > 0.0:
                try:
                    return fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    time.sleep(0.05)
                    _patience -= 0.05

    def _end_turn(self) -> None:
        if self._lock is not None:
            with contextlib.suppress(OSError):
                fcntl.flock(self._lock, fcntl.LOCK_UN)  # a forked process may have it open
            self._lock.close()
            self._lock = None


def _read_whole(path: Path) -> bytes:
    """Return what was written to a file behind its checksum; nothing if they do not agree."""
    try:
        found = path.read_bytes()
    except OSError:
        return b''
    checksum, content = found[:_CHECKSUM_SIZE], found[_CHECKSUM_SIZE:]
    return content if hashlib.sha256(content).digest() == checksum else b''


def _list(path: Path) -> None:
    """Write the list of files that a frame needs, once each function has one."""
    _kept.add(path.name)
    if len(_kept) == len(_entry_points) and not is_code_kept():
        with contextlib.suppress(OSError):
            (path.parent / _ALL).write_text('\n'.join(sorted(_kept)))


def _log_not_kept(reason: object) -> None:
    log_once(
        logging.WARNING,
        f'compiled code is not kept on disk (%s): every start compiles, which takes {DURATION}; '
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
    digest = hashlib.sha256('\n'.join([str(_CORE), *versions]).encode())
    for path in sorted(_CORE.rglob('*.py')):
        digest.update(path.name.encode() + b'\0' + path.read_bytes())
    return digest.hexdigest()[:16]


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
    return bool(names) and all(_read_whole(folder / name) for name in names)
