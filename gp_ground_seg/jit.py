"""The one policy for code compiled with numba, which is optional, and for keeping it on disk.

numba keeps compiled code itself (``cache=True``). Beside its entries lies a stamp with a digest of
our sources, versions, and a checksum of each entry; entries that do not fit it are deleted
before numba reads them, and compiled again. A folder that anyone but the user and root could
write to is not used, as its entries are code.
"""

from __future__ import annotations

import contextlib
import functools
import grp
import hashlib
import importlib.util
import json
import logging
import os
import pwd
import stat
import sys
from collections.abc import Callable
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
_PACKAGE = Path(__file__).parent
_SOURCES = ('jit.py', 'frame.py', 'parameters', 'pipeline', 'gp', 'compiled')
_entry_points: list[Any] = []
_folder: Path | None = None
_is_warm = False
_n_ready = _n_stamped = 0


class _Decorator(Protocol):
    def __call__(self, function: _Function) -> _Function: ...


def jit(*, fastmath: bool = False, entry: bool = False) -> _Decorator:
    """Return a decorator that compiles a function where numba is installed.

    Compiled functions release the interpreter's lock.

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
    """

    def decorate(function: _Function) -> _Function:
        if not JIT_ENABLED:
            return function
        import numba

        options: dict[str, Any] = {'nogil': True, 'error_model': 'numpy'}
        if fastmath:
            options['fastmath'] = {'reassoc', 'contract', 'nsz'}
        if not entry:
            part: _Function = numba.njit(**options)(function)
            return part
        compiled: _Function = _njit_kept(function, options)
        _entry_points.append(compiled)
        return compiled

    return decorate


def _njit_kept(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Compile `function` with its code kept on disk, if there is a folder to trust for it."""
    import numba

    # By the XDG specification such a path is invalid; numba would write to the current folder.
    if os.path.isabs(os.environ.get('XDG_CACHE_HOME', '/')):
        try:
            kept = numba.njit(**options, cache=True)(function)
        except RuntimeError:
            _log_not_kept('there is no folder to write to')
        else:
            if _prepare(Path(kept.stats.cache_path)):
                return kept
    else:
        _log_not_kept('XDG_CACHE_HOME is no absolute path')
    return numba.njit(**options)(function)


@functools.cache
def _log_not_kept(reason: str) -> None:
    _LOGGER.warning(
        'compiled code is not kept on disk (%s): every start compiles, which takes 10 to 40 s; '
        'set NUMBA_CACHE_DIR to a folder of your own',
        reason,
    )


@functools.cache
def _prepare(folder: Path) -> bool:
    """Whether code is kept in `folder`; entries that do not fit the stamp are deleted."""
    global _folder, _is_warm
    reason = _why_not_trusted(folder)
    if reason:
        _log_not_kept(reason)
        return False
    _folder = folder
    stamp = _read_stamp(folder)
    if stamp == {**_stamp(folder), 'warm': stamp.get('warm')}:
        _is_warm = stamp['warm'] is True
        return True
    _LOGGER.info('compiling for this processor, which takes 10 to 40 s')
    for entry in _entries(folder):
        with contextlib.suppress(OSError):
            entry.unlink()
        if entry.exists():
            _log_not_kept(f'{entry} cannot be deleted')
            return False
    return True


def _why_not_trusted(folder: Path) -> str:
    """Reason why others could put code into `folder`; empty if they cannot."""
    if not folder.is_absolute():
        return f'{folder} is no absolute path'
    for path in (folder, *folder.parents):
        status = path.stat()
        if status.st_uid not in (0, os.getuid()):
            return f'{path} belongs to another user'
        # Of a sticky folder, such as /tmp, only the owner of an entry can replace it.
        is_sticky = path != folder and status.st_mode & stat.S_ISVTX
        if not is_sticky and _others_can_write(status):
            return f'others can write to {path}'
    return next((f'{e} is not yours' for e in _entries(folder) if not _is_own(e)), '')


def _is_own(entry: Path) -> bool:
    status = entry.lstat()
    return stat.S_ISREG(status.st_mode) and status.st_uid in (0, os.getuid())


def _others_can_write(status: os.stat_result) -> bool:
    if status.st_mode & stat.S_IWOTH:
        return True
    if not status.st_mode & stat.S_IWGRP:
        return False
    # Ubuntu gives each user a group of the same name, and lets that group write.
    try:
        user, group = pwd.getpwuid(os.getuid()).pw_name, grp.getgrgid(status.st_gid)
    except KeyError:
        return True
    return group.gr_name != user or any(member != user for member in group.gr_mem)


def _entries(folder: Path) -> list[Path]:
    """Files in which numba of this Python keeps code."""
    major, minor = sys.version_info[:2]
    return sorted(folder.glob(f'*.py{major}{minor}*.nb[ic]'))


def _stamp(folder: Path) -> dict[str, Any]:
    """Describe the entries in `folder`: sources, versions, checksums."""
    import numba

    sources = hashlib.sha256()
    for source in sorted(_PACKAGE.rglob('*.py')):
        if source.parent.name in _SOURCES or source.name in _SOURCES:
            sources.update(source.name.encode() + b'\0' + source.read_bytes())
    entries = {e.name: hashlib.sha256(e.read_bytes()).hexdigest() for e in _entries(folder)}
    versions = {'numba': numba.__version__, 'numpy': np.__version__, 'python': sys.version}
    return {'sources': sources.hexdigest(), 'versions': versions, 'entries': entries}


def _stamp_file(folder: Path) -> Path:
    return folder / f'gp_ground_seg.{sys.implementation.cache_tag}.stamp'


def _read_stamp(folder: Path) -> dict[str, Any]:
    try:
        stamp = json.loads(_stamp_file(folder).read_bytes())
    except (OSError, ValueError):
        return {}
    return stamp if isinstance(stamp, dict) else {}


def keep_code(*, warm: bool = False) -> None:
    """Stamp the code that numba has kept since the last call, so that the next start uses it.

    Parameters
    ----------
    warm : bool
        Whether all code that a frame needs has been compiled.
    """
    global _n_ready, _n_stamped, _is_warm
    n_ready = sum(len(entry.overloads) for entry in _entry_points)
    if _folder is None or (n_ready == _n_ready and not warm):
        return
    _n_ready = n_ready
    # Of those the ones that were compiled, not loaded; slow to count.
    n_compiled = sum(len(entry.stats.cache_misses) for entry in _entry_points)
    if n_compiled == _n_stamped and (_is_warm or not warm):
        return
    _n_stamped, _is_warm = n_compiled, _is_warm or warm
    target = _stamp_file(_folder)
    unfinished = target.with_suffix(f'.{os.getpid()}')
    try:
        unfinished.write_text(json.dumps({**_stamp(_folder), 'warm': _is_warm}))
        os.replace(unfinished, target)
    except OSError as error:
        _log_not_kept(f'{target}: {error.strerror}')


def is_code_kept() -> bool:
    """Whether all code that a frame needs lies on disk; `keep_code` was called with `warm`."""
    return _is_warm


def code_folder() -> Path | None:
    """Folder where compiled code is kept; None where it is not kept."""
    return _folder
