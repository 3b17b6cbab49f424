"""The lowest points around the sensor: where the ground may be, a few hundred of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gp_ground_seg.compiled import compiled
from gp_ground_seg.polar_grid import Candidates, FloatArray, IntArray

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

_N_RINGS = math.ceil(math.log(FARTHEST / NEAREST) / math.log(RING_RATIO))
_RING_EDGES = NEAREST * RING_RATIO ** np.arange(_N_RINGS + 1.0)
_NONE = -1


@dataclass(frozen=True)
class LowCells:
    """Lowest point of each occupied cell: sectors by rings, rings wider the farther they are.

    Attributes
    ----------
    x, y, z : (C,) float64
        The points [m]; z along the axis that is taken to be up.
    tolerance : (C,) float64
        Distance of the point to the plane that it still supports [m].
    sector : (C,) int64
        Sector of each cell, 0 to `N_SECTORS` - 1.
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    tolerance: FloatArray
    sector: IntArray


def low_cells(candidates: Candidates, use_compiled: bool) -> LowCells:
    """Thin the ground candidates out to the lowest of each cell.

    Equally low ones are settled by the smaller range, then by the segment, so that the
    order of the points does not matter.

    Parameters
    ----------
    candidates : Candidates
        Lowest points of the bins of the polar grid. A point's azimuth is taken to be
        that of the middle of its segment.
    use_compiled : bool
        Compiled code, or its twin in numpy.
    """
    n_segments = len(candidates.offsets) - 1
    lowest = np.full(N_SECTORS * _N_RINGS, _NONE)
    fill = lowest_compiled if use_compiled else _lowest
    fill(candidates.offsets, candidates.r, candidates.z, _RING_EDGES, lowest)
    cell = np.flatnonzero(lowest != _NONE)
    index = lowest[cell]
    segment = np.searchsorted(candidates.offsets, index, side='right') - 1
    azimuth = (segment + 0.5) * (2.0 * np.pi / n_segments) - np.pi
    r = candidates.r[index]
    return LowCells(
        x=r * np.cos(azimuth),
        y=r * np.sin(azimuth),
        z=candidates.z[index],
        tolerance=TOLERANCE + TOLERANCE_GROWTH * r,
        sector=cell // _N_RINGS,
    )


def _lowest(
    offsets: IntArray, r: FloatArray, z: FloatArray, edges: FloatArray, lowest: IntArray
) -> None:
    """Write the index of the lowest candidate of each cell, sector by sector, into `lowest`."""
    near = np.flatnonzero((r >= edges[0]) & (r < edges[-1]) & (np.abs(z) < MAX_Z))
    n_segments = len(offsets) - 1
    segment = np.repeat(np.arange(n_segments), np.diff(offsets))[near]
    ring = np.searchsorted(edges, r[near], side='right') - 1
    cell = (segment * N_SECTORS // n_segments) * _N_RINGS + ring
    order = np.lexsort((segment, r[near], z[near], cell))
    occupied, first = np.unique(cell[order], return_index=True)
    lowest[occupied] = near[order[first]]


@compiled
def lowest_compiled(
    offsets: IntArray, r: FloatArray, z: FloatArray, edges: FloatArray, lowest: IntArray
) -> None:
    """Do what `_lowest` does."""
    n_segments, n_rings = len(offsets) - 1, len(edges) - 1
    for m in range(n_segments):
        sector = m * N_SECTORS // n_segments
        ring = 0
        for c in range(offsets[m], offsets[m + 1]):
            if not (edges[0] <= r[c] < edges[n_rings] and abs(z[c]) < MAX_Z):
                continue
            while r[c] < edges[ring]:
                ring -= 1
            while r[c] >= edges[ring + 1]:
                ring += 1
            cell = sector * n_rings + ring
            best = lowest[cell]
            if best == _NONE or z[c] < z[best] or (z[c] == z[best] and r[c] < r[best]):
                lowest[cell] = c
