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


def lowest_points(candidates: Candidates) -> LowestPoints:
    """Lowest ground candidate of each cell, in sectors by rings.

    It is the lowest that has `N_TOGETHER` - 1 more within its tolerance above it; where there is
    none, the lowest. Of equally low ones the first candidate comes first.
    """
    r, z, n_segments = candidates.r, candidates.z, candidates.n_segments
    near = np.flatnonzero((r >= RING_EDGES[0]) & (r < RING_EDGES[-1]) & (np.abs(z) < MAX_Z))
    ring = np.searchsorted(RING_EDGES, r[near], side='right') - 1
    cell = (candidates.segment[near] * N_SECTORS // n_segments) * N_RINGS + ring
    # By cell, then by height, as one number: heights add less than half of one.
    order = np.argsort(cell + z[near] / (4.0 * MAX_Z), kind='stable')
    near, cell = near[order], cell[order]
    k = N_TOGETHER - 1
    low, high = near[:-k], near[k:]
    is_together = (cell[:-k] == cell[k:]) & (z[high] - z[low] <= tolerance_at(r[low]))
    first, together = np.flatnonzero(is_new(cell)), np.flatnonzero(is_together)
    together = together[is_new(cell[together])]
    lowest, is_alone = near[first], np.ones(len(first), dtype=np.bool_)
    place = np.searchsorted(cell[first], cell[together])
    lowest[place], is_alone[place] = near[together], False
    x, y, r = candidates.x[lowest], candidates.y[lowest], r[lowest]
    weight = np.minimum(r / MIDDLE, 1.0) ** 2 * nearness(r)
    inverse = 1.0 / tolerance_at(r)
    return LowestPoints(x, y, z[lowest], r, inverse, weight, cell[first], z[near[first]], is_alone)


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
