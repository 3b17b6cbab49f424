"""Compiled code kept on disk: numba's cache, made fit for robots.

numba's own cache needs a writable folder even to read from, fails for good on a file
that a loss of power cut short, and does not notice when a function in *another* file,
or a constant, that the compiled code contains was changed by an upgrade.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FunctionType
from typing import Any

import numpy as np
from numba.core import config as numba_config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile

_LOGGER = logging.getLogger('gp_ground_seg')

_said: set[str] = set()
_refused: list[str] = []


class CodeNotKeptError(Exception):
    """Code would have to be compiled, or was and cannot be kept, and that is refused."""


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Raise `CodeNotKeptError` for what is otherwise put up with.

    Parameters
    ----------
    what : str
        ``compilation``, or the ``loss`` of compiled code that cannot be kept on disk.
    """
    _refused.append(what)
    try:
        yield
    finally:
        _refused.pop()


def say_that_it_compiles() -> None:
    """Log, once in a process, that compiling takes its time."""
    _say_once(logging.INFO, 'compiling for this processor, which takes 10 to 40 s')


def _say_once(level: int, message: str, *facts: str) -> None:
    """Log a message for the first of many functions that it goes for."""
    if message not in _said:
        _said.add(message)
        _LOGGER.log(level, message, *facts)


# numba's order: NUMBA_CACHE_DIR, __pycache__ beside the source, the user's cache folder.
_USER_PROVIDED, _IN_TREE, _USER_WIDE = CompileResultCacheImpl._locator_classes[:3]


class _UnwritableLocator(_IN_TREE):  # type: ignore[misc, valid-type]
    """``__pycache__`` beside the source, whether or not anything can be written there."""

    @classmethod
    def from_function(cls, py_func: FunctionType, py_file: str) -> Any:
        """Return a locator for any function that has a source file."""
        return cls(py_func, py_file) if os.path.exists(py_file) else None


class _CacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = [  # noqa: RUF012
        *CompileResultCacheImpl._locator_classes,
        _UnwritableLocator,
    ]


class KeptCode(FunctionCache):  # type: ignore[misc]
    """Cache of one compiled function.

    Code is written to the first folder of numba's that can be written to, and read from
    any of them: an image of a system may bring its own, read-only. Only where
    NUMBA_CACHE_DIR names a folder that can be written to, no other one is looked into.
    Nothing that goes wrong here costs more than the time to compile.
    """

    _impl_class = _CacheImpl

    def __init__(self, py_func: Callable[..., Any]) -> None:
        super().__init__(py_func)
        source = inspect.getfile(py_func)
        classes = [_USER_PROVIDED] if numba_config.CACHE_DIR else []
        if not isinstance(self._impl.locator, _USER_PROVIDED):
            classes += [_IN_TREE, _USER_WIDE]
        paths = [cls(py_func, source).get_cache_path() for cls in classes]
        base, stamp = self._impl.filename_base, self._impl.locator.get_source_stamp()
        self._files = [
            IndexDataCacheFile(path, base, stamp)
            for path in dict.fromkeys([self.cache_path, *paths])
        ]

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), digest(self._py_func))

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        key = self._index_key(sig, target_context.codegen())
        for file in self._files:
            try:
                data = file.load(key)
                if data is not None:
                    return self._impl.rebuild(target_context, data)
            except Exception as error:
                # Whatever is wrong with a file, compiling writes it anew.
                _LOGGER.info('compiled code kept of %s cannot be used: %r', self._name, error)
        if 'compilation' in _refused:
            raise CodeNotKeptError(self._name)
        say_that_it_compiles()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for a signature; where that fails, it is compiled again next time."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            self._say_not_kept(error.strerror or str(error))
        except Exception:
            self._save_anew(sig, data)

    def _save_anew(self, sig: Any, data: Any) -> None:
        """Drop the index, which cannot be read, first."""
        try:
            self.flush()
            super().save_overload(sig, data)
        except Exception as error:
            self._say_not_kept(repr(error))

    def _say_not_kept(self, reason: str) -> None:
        if 'loss' in _refused:
            raise CodeNotKeptError(reason)
        _say_once(
            logging.WARNING,
            'compiled code cannot be kept in %s (%s): every start compiles anew; '
            'set NUMBA_CACHE_DIR to a folder that is writable',
            self.cache_path,
            reason,
        )


def digest(function: FunctionType) -> str:
    """Digest of a function's code, of the compiled functions it calls, and of its constants."""
    hasher = hashlib.sha256()
    _feed(hasher, function, set())
    return hasher.hexdigest()


def _feed(hasher: Any, function: FunctionType, seen: set[int]) -> None:
    if id(function) in seen:
        return
    seen.add(id(function))
    for name in _feed_code(hasher, function.__code__):
        value = function.__globals__.get(name)
        # Of a compiled function, or of what generates instructions by hand and its helpers.
        compiled_from = getattr(value, 'py_func', getattr(value, '_defn', value))
        if isinstance(compiled_from, FunctionType):
            _feed(hasher, compiled_from, seen)
        elif isinstance(value, np.ndarray):
            hasher.update(name.encode() + value.tobytes())
        elif isinstance(value, bool | int | float | complex | str | tuple | np.generic):
            hasher.update(f'{name}={value!r}'.encode())


def _feed_code(hasher: Any, code: CodeType) -> list[str]:
    """Feed code and constants, those of nested functions too; return all names used."""
    hasher.update(code.co_code)
    names = list(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names += _feed_code(hasher, constant)
        else:
            # Sets of words come in another order in each process.
            plain = sorted(map(repr, constant)) if isinstance(constant, frozenset) else constant
            hasher.update(repr(plain).encode())
    return names
