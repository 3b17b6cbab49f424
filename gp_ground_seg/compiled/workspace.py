"""Arrays that are used again in the next frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt


class Workspace:
    """Arrays by name, as long as the largest frame so far needed.

    A new array of a megabyte costs as much as a pass over it: its pages are
    mapped and cleared one by one. What is taken from here must not outlive the frame.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, npt.NDArray[Any]] = {}
        self._views: dict[str, npt.NDArray[Any]] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """Array of that shape with whatever was in it, C-contiguous.

        Parameters
        ----------
        name : str
            One name, one purpose: a second call with it hands out the same memory.
        shape : tuple of int
            Shape wanted.
        dtype : dtype
            Type of the elements.
        """
        view = self._views.get(name)
        if view is not None and view.shape == shape and view.dtype == dtype:
            return view
        size = math.prod(shape)
        held = self._arrays.get(name)
        if held is None or len(held) < size or held.dtype != np.dtype(dtype):
            held = self._arrays[name] = np.empty(size, dtype=dtype)
        view = self._views[name] = held[:size].reshape(shape)
        return view
