"""The one policy for code compiled with numba, which is optional, and for keeping it on disk.

numba keeps compiled code itself (``cache=True``), here in a folder of the user whose name is a
digest of our sources and of versions: code of other sources is never read. An entry that does not
fit its checksum, as after a power cut, is compiled again. Processes that use a folder hold a lock
on it: what another one has just compiled is not yet noted, and must not be taken for damaged.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import importlib.util
import json
import logging
import os
import shutil
import stat
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

# Ubuntu 24.04 has no package of numba. Its import takes most of a second: it waits until something
# is to be compiled.
HAVE_NUMBA = importlib.util.find_spec('numba') is not None
JIT_ENABLED = HAVE_NUMBA and os.environ.get('NUMBA_DISABLE_JIT', '0') in ('', '0')
"""Whether functions are compiled, rather than left plain Python."""

_LOGGER = logging.getLogger('gp_ground_seg')
_Function = TypeVar('_Function', bound=Callable[..., Any])
_CORE = Path(__file__).parent
_entry_points: list[Any] = []
_shared: list[Callable[..., Any]] = []
_KEPT, _LOCK = 'kept.json', 'lock'
_is_warm = _is_missing = _is_not_kept = False
_n_ready = _n_kept = 0


class _Decorator(Protocol):
    def __call__(self, function: _Function) -> _Function: ...


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
) -> _Decorator:
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


def jit(*, fastmath: bool = False, entry: bool = False, part: bool = False) -> _Decorator:
    """Return a decorator that compiles a function where numba is installed.

    Compiled functions release the interpreter's lock. One that is neither `entry` nor `part` runs
    as plain Python where Python calls it.

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
        compiled: _Function = _njit_kept(function, _options())
        _entry_points.append(compiled)
        return compiled

    return decorate


@functools.cache
def announce_compiling() -> None:
    """Log once, where code is about to run that is not kept on disk, that it is compiled."""
    if _is_missing:
        _LOGGER.info('compiling for this processor, which takes 20 to 60 s')


def _njit_kept(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Compile `function` with its code kept on disk, if there is a folder to trust for it."""
    import numba

    folder = code_folder()
    if folder is not None:
        # numba reads this once, here. Without it, code would lie beside our sources.
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
        try:
            kept = numba.njit(**options, cache=True)(function)
        finally:
            numba.config.CACHE_DIR = before
        if folder in Path(kept.stats.cache_path).parents:
            # numba has no public hook for a full disk; a numba without these names goes without.
            cache = getattr(kept, '_cache', None)
            for name in ('load_overload', 'save_overload'):
                if hasattr(cache, name):
                    setattr(cache, name, _or_nothing(getattr(cache, name)))
            return kept
        _log_not_kept(f'{folder} cannot be written to')
    return numba.njit(**options)(function)


def _or_nothing(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return `method` of numba's cache, without the errors of a disk that is full or damaged."""

    def attempt(*arguments: Any) -> Any:
        try:
            return method(*arguments)
        except OSError as error:
            _log_not_kept(str(error))
            return None

    return attempt


def _log_not_kept(reason: str) -> None:
    """Log once that code is compiled at every start."""
    global _is_not_kept
    if _is_not_kept:
        return
    _is_not_kept = True
    _LOGGER.warning(
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
        lock, is_alone = _lock(folder)
        try:
            _delete_damaged(folder, is_alone)
        finally:
            fcntl.flock(lock, fcntl.LOCK_SH)
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home
        _log_not_kept(str(error))
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


def _lock(folder: Path) -> tuple[int, bool]:
    """Lock `folder` until the process ends, and say whether no other uses it.

    The file has the place of our sources, by which `_delete_old` knows code of earlier ones.
    """
    lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fcntl.flock(lock, fcntl.LOCK_SH)  # once the other has looked at the files
        return lock, False
    if os.fstat(lock).st_size == 0:
        with contextlib.suppress(OSError):  # the disk is full
            os.write(lock, os.fsencode(_CORE))
    return lock, True


def _delete_old(folder: Path) -> None:
    """Delete code beside `folder` of other sources in our place, or in one that is gone."""
    for path in folder.parent.glob(f'*/{_LOCK}'):
        sources = os.fsdecode(path.read_bytes())
        if path.parent == folder or not (sources == str(_CORE) or not Path(sources).exists()):
            continue
        with path.open('rb') as lock, contextlib.suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(path.parent, ignore_errors=True)


def _digest() -> str:
    """Name of what the code was compiled from: sources, where they lie, and versions."""
    versions = [sys.version, np.__version__, *map(metadata.version, ('numba', 'llvmlite'))]
    digest = hashlib.sha256('\n'.join([str(_CORE), *versions]).encode())
    for source in sorted(_CORE.rglob('*.py')):
        digest.update(source.name.encode() + b'\0' + source.read_bytes())
    return digest.hexdigest()[:16]


def _checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of each file in which numba keeps code, by its path in `folder`."""
    found = {}
    for entry in folder.rglob('*.nb[ic]'):
        with contextlib.suppress(FileNotFoundError):  # another process has just deleted it
            name = entry.relative_to(folder).as_posix()
            found[name] = hashlib.sha256(entry.read_bytes()).hexdigest()
    return found


def _read_kept(folder: Path) -> dict[str, Any]:
    """Return what `keep_code` has noted."""
    try:
        kept = json.loads((folder / _KEPT).read_bytes())
    except (OSError, ValueError):
        return {}
    return kept if isinstance(kept, dict) else {}


def _write_kept(folder: Path, kept: dict[str, Any]) -> None:
    """Note what `_read_kept` returns."""
    unfinished = folder / f'{_KEPT}.{os.getpid()}'
    unfinished.write_text(json.dumps(kept))
    os.replace(unfinished, folder / _KEPT)


def _delete_damaged(folder: Path, is_alone: bool) -> None:
    """Delete the files that do not fit their checksum; numba compiles again what they held.

    Unless we are alone, one without a checksum may be of a process that compiles.
    """
    global _is_warm, _is_missing
    kept, found = _read_kept(folder), _checksums(folder)
    damaged = [
        name
        for name, checksum in found.items()
        if kept.get(name) != checksum and (is_alone or name in kept)
    ]
    for name in damaged:
        (folder / name).unlink(missing_ok=True)
    if is_alone and kept.keys() & damaged:
        # What takes their place has no checksum yet, rather than a wrong one.
        left = {name: checksum for name, checksum in kept.items() if name not in damaged}
        _write_kept(folder, {**left, 'warm': False})
    is_whole = bool(kept) and not damaged and found.keys() >= kept.keys() - {'warm'}
    _is_warm, _is_missing = is_whole and kept.get('warm') is True, not is_whole


def keep_code() -> None:
    """Note checksums of the code that numba has kept, so that the next start uses it."""
    global _n_ready, _n_kept, _is_warm
    n_ready = sum(len(entry.overloads) for entry in _entry_points)
    folder = code_folder()
    if folder is None or n_ready == _n_ready:
        return
    _n_ready = n_ready
    # Of those the ones that were compiled, not loaded; slow to count.
    n_compiled = sum(len(entry.stats.cache_misses) for entry in _entry_points)
    warm = _is_whole() and not _is_not_kept
    if n_compiled == _n_kept and (_is_warm or not warm):
        return
    _n_kept, _is_warm = n_compiled, _is_warm or warm
    try:
        found = _checksums(folder)
        # Fewer files than functions: another process has deleted some as damaged.
        _is_warm = _is_warm and sum(name.endswith('.nbc') for name in found) >= len(_entry_points)
        _write_kept(folder, {**found, 'warm': _is_warm})
        if _is_warm:
            _delete_old(folder)
    except OSError as error:
        _log_not_kept(str(error))


def has_to_compile() -> bool:
    """Whether the first frame in compiled code would take long: none is kept, none is at hand."""
    return JIT_ENABLED and not (_is_whole() or (code_folder() is not None and _is_warm))


def count_ready() -> tuple[int, int]:
    """How many functions are compiled or loaded in this process, and how many there are."""
    return sum(bool(entry.overloads) for entry in _entry_points), len(_entry_points)


def _is_whole() -> bool:
    """Whether each function that is called from Python is compiled or loaded in this process."""
    n_ready, n_functions = count_ready()
    return 0 < n_functions == n_ready


def is_code_kept() -> bool:
    """Whether all code that a frame needs lies on disk."""
    return _is_warm
