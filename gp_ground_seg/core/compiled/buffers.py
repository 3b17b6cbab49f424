"""Arrays that the next frame uses again."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import CellArray, PointArray


class TileTable(NamedTuple):
    """Extremes of the points of each tile.

    Attributes
    ----------
    extremes : (T + 1, 2) float32 or float64
        Height of the lowest and the highest point [m]; infinite, minus infinite in empty
        tiles. The last row is for points in no tile.
    occupied : (T + 2,) int32
        Number of tiles with a point, then these tiles. Code that fills the table first empties
        those, a tenth of all.
    """

    extremes: PointArray
    occupied: CellArray

    @classmethod
    def empty(cls, n_tiles: int, dtype: npt.DTypeLike) -> TileTable:
        """Table without a point."""
        extremes = np.empty((n_tiles + 1, 2), dtype=dtype)
        extremes[:, 0], extremes[:, 1] = np.inf, -np.inf
        return cls(extremes, np.zeros(n_tiles + 2, dtype=np.int32))


class Buffers:
    """Arrays by name, as long as the largest frame so far needed.

    A new array of a megabyte costs as much as a pass over it: its pages are
    mapped and cleared one by one. What is taken from here must not outlive the frame.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, npt.NDArray[Any]] = {}
        self._views: dict[str, npt.NDArray[Any]] = {}
        self._tiles: TileTable | None = None

    def take(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """Array of that shape with arbitrary content, C-contiguous.

        Parameters
        ----------
        name : str
            One name, one purpose: a second call with it returns the same memory.
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

    def tile_table(self, n_tiles: int, dtype: npt.DTypeLike) -> TileTable:
        """Table as the last scan left it, or a new one of the size wanted."""
        held = self._tiles
        if held is None or len(held.extremes) != n_tiles + 1 or held.extremes.dtype != dtype:
            held = self._tiles = TileTable.empty(n_tiles, dtype)
        return held
