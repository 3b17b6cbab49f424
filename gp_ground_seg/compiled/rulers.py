"""Which bin a value lies in, by a table instead of a search."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gp_ground_seg.frame import CellArray, FloatArray, PointArray
from gp_ground_seg.parameters.config import GridConfig
from gp_ground_seg.pipeline.polar_grid import bin_edges, reach, segment_edges

LARGEST_TABLE = 2**15
EARLY = 0.02
"""How much earlier the entries of a table begin, in entries: more than single precision
puts a value off in the largest table."""


class Ruler(NamedTuple):
    """Edges of bins, and a table that tells the bin of a value without a search.

    Attributes
    ----------
    edges : (n + 1,) float32 or float64
        A value lies at or beyond the exact edge if, and only if, it does beyond this one
        (see `gp_ground_seg.pipeline.polar_grid.reach`); in the precision of the values.
    bins : (T,) int32
        Bin of the values from ``edges[0] + k / scale`` on, a little early.
    ends : (T,) float32 or float64
        Where that bin ends.
    scale : float
        Entries per unit.
    is_coarse : bool
        Whether more than one edge may lie in an entry.
    """

    edges: PointArray
    bins: CellArray
    ends: PointArray
    scale: float
    is_coarse: bool


def make_ruler(edges: FloatArray, fineness: int, dtype: np.dtype[np.floating]) -> Ruler:
    """Ruler of the bins between `edges` (n + 1,) for values of type `dtype`.

    Parameters
    ----------
    edges : (n + 1,) float64
        Edges of the bins.
    fineness : int
        Entries in the narrowest bin. Fewer where there would be more than
        `LARGEST_TABLE` in all.
    dtype : dtype
        Precision of the values.
    """
    extent, narrowest = float(edges[-1] - edges[0]), float(np.diff(edges).min())
    scale = min(fineness / narrowest, LARGEST_TABLE / extent)
    size = int(extent * scale) + 2
    # A little early, so that rounding never puts an entry too far.
    starts = edges[0] + (np.arange(size) - EARLY) / scale
    bins = np.clip(np.searchsorted(edges, starts, side='right') - 1, 0, len(edges) - 2)
    own_edges = np.array([reach(edges[: k + 1], dtype) for k in range(len(edges))], dtype=dtype)
    is_coarse = narrowest * scale < 1.0 + 2.0 * EARLY
    arrays = own_edges, bins.astype(np.int32), own_edges[bins + 1]
    for array in arrays:
        array.setflags(write=False)
    return Ruler(*arrays, scale, is_coarse)


@lru_cache(maxsize=4)
def grid_rulers(grid: GridConfig, dtype: np.dtype[np.floating]) -> tuple[FloatArray, Ruler, Ruler]:
    """Edges of the bins (n_bins + 1,) float64, their ruler, and that of the segments."""
    edges = bin_edges(grid)
    turns = segment_edges(grid.n_segments)
    return edges, make_ruler(edges, 4, dtype), make_ruler(turns, 8, dtype)
