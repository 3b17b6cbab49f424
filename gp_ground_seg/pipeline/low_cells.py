"""The lowest points around the sensor: where the ground may be, a few hundred of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gp_ground_seg.frame import Candidates, FloatArray, IntArray

N_SECTORS = 36
NEAREST, FARTHEST = 0.5, 40.0
"""Horizontal ranges between which the ground tells the pose [m]: nearer there is the vehicle
itself, farther the ground has time to curve."""
RING_RATIO = 1.25
"""Outer over inner radius of a ring: what a cell weighs does not depend on how high the sensor
is, and near ground weighs more than far."""
TOLERANCE, TOLERANCE_GROWTH = 0.08, 0.015
"""Distance to a plane that a cell still supports [m], and its growth with range: what noise,
kerbs and camber make of a plane."""
MAX_Z = 65.0
"""Points farther above or below the sensor are none of the ground near it [m]."""

N_RINGS = math.ceil(math.log(FARTHEST / NEAREST) / math.log(RING_RATIO))
RING_EDGES = NEAREST * RING_RATIO ** np.arange(N_RINGS + 1.0)
_NONE = -1


@dataclass(frozen=True)
class LowCells:
    """Lowest point of each occupied cell: sectors by rings, rings wider the farther they are.

    Attributes
    ----------
    x, y, z : (C,) float64
        The points [m]; z along the axis that is taken to be up.
    r : (C,) float64
        Horizontal range of the points [m].
    tolerance : (C,) float64
        Distance of the point to the plane that it still supports [m].
    sector : (C,) int64
        Sector of each cell, 0 to `N_SECTORS` - 1.
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    r: FloatArray
    tolerance: FloatArray
    sector: IntArray


@lru_cache(maxsize=4)
def directions(n_segments: int) -> FloatArray:
    """Cosine and sine of the azimuth of the middle of each segment, (2, n_segments)."""
    azimuth = (np.arange(n_segments) + 0.5) * (2.0 * np.pi / n_segments) - np.pi
    table = np.stack([np.cos(azimuth), np.sin(azimuth)])
    table.setflags(write=False)
    return table


def low_cells(candidates: Candidates) -> LowCells:
    """Thin the ground candidates out to the lowest of each cell.

    Equally low ones are settled by the smaller range, then by the segment, so that the
    order of the points does not matter.

    Parameters
    ----------
    candidates : Candidates
        Lowest points of the bins of the polar grid. A point's azimuth is taken to be
        that of the middle of its segment.
    """
    lowest = _lowest(candidates.offsets, candidates.r, candidates.z)
    cell = np.flatnonzero(lowest != _NONE)
    index = lowest[cell]
    segment = np.searchsorted(candidates.offsets, index, side='right') - 1
    cosine, sine = directions(len(candidates.offsets) - 1)
    r = candidates.r[index]
    return LowCells(
        x=r * cosine[segment],
        y=r * sine[segment],
        z=candidates.z[index],
        r=r,
        tolerance=TOLERANCE + TOLERANCE_GROWTH * r,
        sector=cell // N_RINGS,
    )


def _lowest(offsets: IntArray, r: FloatArray, z: FloatArray) -> IntArray:
    """Index of the lowest candidate of each cell, sector by sector, or `_NONE`."""
    near = np.flatnonzero((r >= RING_EDGES[0]) & (r < RING_EDGES[-1]) & (np.abs(z) < MAX_Z))
    n_segments = len(offsets) - 1
    segment = np.repeat(np.arange(n_segments), np.diff(offsets))[near]
    ring = np.searchsorted(RING_EDGES, r[near], side='right') - 1
    cell = (segment * N_SECTORS // n_segments) * N_RINGS + ring
    order = np.lexsort((segment, r[near], z[near], cell))
    occupied, first = np.unique(cell[order], return_index=True)
    lowest = np.full(N_SECTORS * N_RINGS, _NONE)
    lowest[occupied] = near[order[first]]
    return lowest
