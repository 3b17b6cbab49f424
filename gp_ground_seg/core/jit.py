"""The one policy for code compiled with numba, which is optional, and for keeping it on disk.

Each compiled function has a file with a checksum, in a folder of the user that is named by our
sources and by versions: code of other sources is never read, and a file that is damaged is
compiled again. Of several processes one compiles, and the others wait for its files.
"""

from __future__ import annotations

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

# Ubuntu 24.04 has no package of numba. Its import takes most of a second: it waits until something
# is to be compiled.
HAVE_NUMBA = importlib.util.find_spec('numba') is not None
JIT_ENABLED = HAVE_NUMBA and os.environ.get('NUMBA_DISABLE_JIT', '0') in ('', '0')
"""Whether functions are compiled, rather than left plain Python."""

_Function = TypeVar('_Function', bound=Callable[..., Any])
_CORE = Path(__file__).parent
_entry_points: list[Any] = []
_shared: list[Callable[..., Any]] = []
_ALL, _LOCK = 'all', 'lock'
_CHECKSUM_SIZE = hashlib.sha256().digest_size
_kept: dict[str, str] = {}  # by function, a file of it that this process has read or written
_turn: IO[bytes] | None = None  # the file that is locked while a process compiles
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
        compiled = numba.njit(**_options())(function)
        if folder := code_folder():
            compiled._cache = _CodeFiles(folder, f'{function.__module__}.{function.__qualname__}')
        _entry_points.append(compiled)
        entry_point: _Function = compiled
        return entry_point

    return decorate


class _CodeFiles:
    """Files of one function, in place of numba's own cache, which has no checksums.

    A numba dispatcher asks for each type of arguments, and hands over what it compiles.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.cache_path, self._name = folder, name

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return what `save_overload` was given; None if numba has to compile it."""
        from numba.core.compiler import CompileResult

        target.refresh()
        path = self._path(signature, target.codegen())
        if (code := _read_whole(path)) is None:
            _begin_turn(self.cache_path)
            if (code := _read_whole(path)) is None:
                log_once(logging.INFO, 'compiling for this processor, which takes 20 to 60 s')
                return None
            _end_turn()  # another process has compiled it meanwhile
        self._list(path)
        return CompileResult._rebuild(target, *pickle.loads(code))

    def save_overload(self, signature: Any, result: Any) -> None:
        """Write what was compiled; a full disk is a warning."""
        from numba.core.serialize import dumps

        path = self._path(signature, result.codegen)
        try:
            if not result.library.has_dynamic_globals:  # addresses in this process
                _write_whole(path, dumps(result._reduce()))
                self._list(path)
        except OSError as error:
            _log_not_kept(error)
        finally:
            _end_turn()

    def _path(self, signature: Any, codegen: Any) -> Path:
        key = f'{signature} {codegen.magic_tuple()}'  # the second is the processor
        digest = hashlib.sha256(key.encode()).hexdigest()[:16]
        return self.cache_path / f'{self._name}-{digest}'

    def _list(self, path: Path) -> None:
        """Write the list of files that a frame needs, once each function has one."""
        _kept[self._name] = path.name
        if len(_kept) == len(_entry_points) and not is_code_kept():
            with contextlib.suppress(OSError):
                _write_whole(self.cache_path / _ALL, '\n'.join(_kept.values()).encode())


def _read_whole(path: Path) -> bytes | None:
    """Return what `_write_whole` was given; None if the file is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    checksum, data = content[:_CHECKSUM_SIZE], content[_CHECKSUM_SIZE:]
    return data if hashlib.sha256(data).digest() == checksum else None


def _write_whole(path: Path, data: bytes) -> None:
    """Write a file with its checksum, at once."""
    unfinished = path.with_name(f'{path.name}.tmp{os.getpid()}')
    try:
        with unfinished.open('wb') as file:
            file.write(hashlib.sha256(data).digest() + data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise


def _begin_turn(folder: Path) -> None:
    """Wait until no other process compiles, or the patience is at an end."""
    global _turn, _patience
    with contextlib.suppress(OSError):  # the disk is full, or has no locks
        _turn = _turn or (folder / _LOCK).open('ab')
        while _patience > 0.0:
            try:
                return fcntl.flock(_turn, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                time.sleep(0.05)
                _patience -= 0.05


def _end_turn() -> None:
    """Let another process compile."""
    global _turn
    if _turn is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(_turn, fcntl.LOCK_UN)  # a forked process may have it open
        _turn.close()
        _turn = None


def _log_not_kept(reason: Exception) -> None:
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
    digest = hashlib.sha256('\n'.join([str(_CORE), *versions]).encode())
    for source in sorted(_CORE.rglob('*.py')):
        digest.update(source.name.encode() + b'\0' + source.read_bytes())
    return digest.hexdigest()[:16]


def has_to_compile() -> bool:
    """Whether the first frame in compiled code would take long."""
    return JIT_ENABLED and not is_code_kept()


def is_code_kept() -> bool:
    """Whether all code that a frame needs lies on disk, whole."""
    folder = code_folder()
    names = folder and _read_whole(folder / _ALL)
    if not (folder and names):
        return False
    return all(_read_whole(folder / name) is not None for name in names.decode().splitlines())
