"""Stage 2: the lowest points around the sensor, to which the plane of the ground is fitted."""

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, Candidates, FloatArray, IntArray, Values
from gp_ground_seg.core.jit import shared

N_SECTORS = 36
NEAREST, FARTHEST = 0.5, 40.0
"""Horizontal ranges of the points that the plane is fitted to [m]: nearer there is the vehicle
itself, farther the ground may curve."""
RING_RATIO = 1.25
"""Outer over inner radius of a ring: the weight of a cell does not depend on the height of the
sensor, and near ground weighs more than far."""
TOLERANCE, TOLERANCE_GROWTH = 0.08, 0.015
"""Distance to a plane that a point still supports [m], and its growth with range: noise,
kerbs and camber bring ground off a plane."""
N_TOGETHER = 3
"""Candidates of a cell within the tolerance over its lowest point, itself included: noise and
mirror images below the ground lie alone."""
MAX_Z = 65.0
"""Height above or below the sensor from which a point is not the ground near it [m]."""

N_RINGS = math.ceil(math.log(FARTHEST / NEAREST) / math.log(RING_RATIO))
RING_EDGES = NEAREST * RING_RATIO ** np.arange(N_RINGS + 1.0)
N_CELLS = N_SECTORS * N_RINGS
MIDDLE = 4.0
"""Range of the points with the most weight [m]: nearer ones may be the robot's own body."""


class LowestPoints(NamedTuple):
    """Lowest point of each occupied cell: sector by sector, rings wider the farther they are."""

    x: FloatArray  # (C,) [m]
    y: FloatArray  # (C,) [m]
    z: FloatArray  # (C,) along the axis that is taken to be up [m]
    r: FloatArray  # (C,) horizontal range [m]
    # (C,) one over the distance to a plane that the point still supports [1/m]
    inverse: FloatArray
    weight: FloatArray  # (C,) the largest, one, at `MIDDLE`
    cell: IntArray  # (C,) number of the cell: sector times `N_RINGS`, plus ring
    # (C,) height of the lowest of all [m], which may lie alone: floor at the foot of a wall
    lowest_z: FloatArray
    is_alone: BoolArray  # (C,) whether there are not `N_TOGETHER`, as where noise is the lowest


@shared
def lowest_points(candidates: Candidates) -> LowestPoints:
    """Lowest ground candidate of each cell, in sectors by rings.

    It is the lowest that has `N_TOGETHER` - 1 more within its tolerance above it; where there is
    none, the lowest. Of equally low ones the first candidate comes first.
    """
    r, z, end = candidates.r, candidates.z, candidates.offsets[1:]
    there, own, n = candidates.offsets.copy(), np.empty(len(r), np.int64), 0
    found, is_alone = np.empty((3, N_CELLS), np.int64), np.ones(N_CELLS, np.bool_)
    first = -(-np.arange(N_SECTORS + 1) * len(end) // N_SECTORS)
    for cell in range(N_CELLS):
        sector, stop, k = cell // N_RINGS, RING_EDGES[cell % N_RINGS + 1], 0
        # Each segment of the sector goes on where the ring before has ended.
        for m in range(first[sector], first[sector + 1]):
            while there[m] < end[m] and r[there[m]] < stop:
                c, place = there[m], k
                there[m] += 1
                if r[c] >= RING_EDGES[0] and abs(z[c]) < MAX_Z:
                    while place > 0 and z[own[place - 1]] > z[c]:
                        own[place] = own[place - 1]
                        place -= 1
                    own[place] = c
                    k += 1
        if k > 0:
            found[0, n], found[1, n], found[2, n] = cell, own[0], own[0]
            for i in range(k - N_TOGETHER + 1):
                if z[own[i + N_TOGETHER - 1]] - z[own[i]] <= tolerance_at(r[own[i]]):
                    found[2, n], is_alone[n] = own[i], False
                    break
            n += 1
    lowest, lowest_z = found[2, :n], z[found[1, :n]]
    x, y, r, z = candidates.x[lowest], candidates.y[lowest], r[lowest], z[lowest]
    inverse, weight = 1.0 / tolerance_at(r), np.minimum(r / MIDDLE, 1.0) ** 2 * nearness(r)
    return LowestPoints(x, y, z, r, inverse, weight, found[0, :n], lowest_z, is_alone[:n])


@shared
def tolerance_at(r: Values) -> Values:
    """Distance to the plane that a point at range `r` still supports [m]."""
    return TOLERANCE + TOLERANCE_GROWTH * r


@shared
def nearness(r: Values) -> Values:
    """Weight of what is at a range, as what carries the robot: the largest, one, to `MIDDLE`."""
    share = MIDDLE / np.maximum(r, MIDDLE)
    return share * share


@shared
def is_new(sector: IntArray) -> BoolArray:
    """Which cells are the nearest of a sector: they come sector by sector, from near to far."""
    result: BoolArray = sector != np.append(-1, sector[:-1])
    return result
