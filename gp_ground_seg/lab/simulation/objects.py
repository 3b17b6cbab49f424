"""Solids that stand on the terrain or float over it: yawed boxes and upright cylinders."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import FloatArray, IntArray
from gp_ground_seg.lab.simulation.terrain import Place, Terrain

KindArray: TypeAlias = npt.NDArray[np.uint8]
Interval: TypeAlias = tuple[FloatArray, FloatArray]
Size: TypeAlias = tuple[float, float, float]  # length, width, height [m]

BURIED_DEPTH = 3.0  # of standing solids below the ground at their centre: none hovers [m]
WALL_PANEL, WALL_THICKNESS = 4.0, 0.3
"""Longest panel of a wall, whose panels follow the ground, and thickness of all [m]."""
SMALLEST_RATE = 1e-12  # for a zero component of a unit vector; keeps 0 / 0 out of `Solid.entry`
Kind = IntEnum(
    'Kind', 'TERRAIN BOX WALL POLE OVERHANG REFLECTION VEGETATION PERSON CYCLIST', start=0
)
"""What a ray can hit."""


SEMANTIC_KITTI = np.array([40, 10, 50, 80, 52, 1, 70, 30, 31], dtype=np.uint32)
"""Class in SemanticKITTI of each `Kind`: road, car, building, pole, other structure (an obstacle,
which vegetation is not), outlier, vegetation, person, bicyclist."""
REFLECTANCE = np.array([0.25, 0.5, 0.4, 0.6, 0.35, 0.05, 0.3, 0.3, 0.3])
"""Share of the light that each `Kind` sends back."""


@dataclass(frozen=True)
class Solid(ABC):
    """A convex solid about x, y, from the height `bottom` to `top` [m]."""

    kind: Kind
    x: float
    y: float
    bottom: float
    top: float
    radius: float  # of the vertical cylinder around it
    # x, y [m] of the vehicle or person that it is a part of.
    part_of: Place | None = field(default=None, kw_only=True)

    @abstractmethod
    def _outline(self, offset: FloatArray, rate: FloatArray) -> list[Interval]:
        """Ranges, all of which a ray in its outline is in.

        The ray begins at `offset` from (x, y, 0) and runs along `rate`, both (R, 3).
        """

    def entry(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        """Range [m] at which each ray (R, 3) enters the solid, infinite if it does not, (R,)."""
        offset = origin - np.array([self.x, self.y, 0.0])
        rate = np.where(np.abs(direction[:, 2]) < SMALLEST_RATE, SMALLEST_RATE, direction[:, 2])
        ends = (np.array([[self.bottom], [self.top]]) - offset[:, 2]) / rate
        between = ends.min(axis=0), ends.max(axis=0)
        intervals = np.array([between, *self._outline(offset, direction)])
        enter, leave = intervals[:, 0].max(axis=0), intervals[:, 1].min(axis=0)
        return np.where((enter <= leave) & (enter > 0.0), enter, np.inf)


Solids: TypeAlias = tuple[Solid, ...]


@dataclass(frozen=True, eq=False)
class Hull(Solid):
    """Convex solid between planes: all p with ``normal . (p - (x, y, 0)) <= limit``."""

    normals: FloatArray  # (K, 3), outward
    limits: FloatArray  # (K,) [m]

    def _outline(self, offset: FloatArray, rate: FloatArray) -> list[Interval]:
        outward = self.normals @ rate.T
        outward[np.abs(outward) < SMALLEST_RATE] = SMALLEST_RATE
        at = (self.limits[:, None] - self.normals @ offset.T) / outward
        leaves = outward > 0.0
        enter, leave = np.where(leaves, -np.inf, at), np.where(leaves, at, np.inf)
        return [(enter.max(axis=0), leave.min(axis=0))]


@dataclass(frozen=True)
class Cylinder(Solid):
    """Upright cylinder."""

    def _outline(self, offset: FloatArray, rate: FloatArray) -> list[Interval]:
        xy, rate = offset[:, :2], rate[:, :2]
        a = np.maximum(np.sum(rate * rate, axis=1), SMALLEST_RATE**2)
        half_b = np.sum(xy * rate, axis=1)
        c = np.sum(xy * xy, axis=1) - self.radius**2
        discriminant = half_b**2 - a * c
        root = np.sqrt(np.maximum(discriminant, 0.0))
        miss = discriminant < 0.0
        enter = np.where(miss, np.inf, (-half_b - root) / a)
        return [(enter, np.where(miss, -np.inf, (-half_b + root) / a))]


def nearest_solid(
    solids: Sequence[Solid], origin: FloatArray, direction: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Range [m] at which each ray first meets a solid, and its index: two (R,); inf, -1 if none.

    `origin`, (3,) or (R, 3) [m], is the start of all rays, which is much faster, or of each;
    `direction`, (R, 3), holds unit vectors.
    """
    distance = np.full(len(direction), np.inf)
    index = np.full(len(direction), -1)
    starts = np.broadcast_to(origin, direction.shape)
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    order = np.argsort(azimuth)
    azimuth = azimuth[order]
    for k, solid in enumerate(solids):
        rays = order[_find_towards(solid, origin, azimuth)] if origin.ndim == 1 else order
        entry = solid.entry(starts[rays], direction[rays])
        nearer = entry < distance[rays]
        distance[rays[nearer]], index[rays[nearer]] = entry[nearer], k
    return distance, index


def number_objects(solids: Iterable[Solid]) -> npt.NDArray[np.int32]:
    """Return the number of the object that each solid is a part of, from 1 on; 0: of none."""
    numbers: dict[Place, int] = {}
    parts = [solid.part_of for solid in solids]
    found = [0 if part is None else numbers.setdefault(part, len(numbers) + 1) for part in parts]
    return np.array(found, dtype=np.int32)


def object_heights(terrain: Terrain, solids: Sequence[Solid]) -> FloatArray:
    """Height of each object above the ground below it, (n + 1,) [m].

    Indexed by the numbers of `number_objects`; NaN at 0, which is no object.
    """
    numbers = number_objects(solids)
    heights = np.full(numbers.max(initial=0) + 1, -np.inf)
    above = [solid.top - float(terrain.height(solid.x, solid.y)) for solid in solids]
    np.maximum.at(heights, numbers, above)
    heights[0] = np.nan
    return heights


def parts_of(x: float, y: float, solids: Iterable[Solid]) -> Solids:
    """Return the solids as parts of the one object at x, y."""
    return tuple(replace(solid, part_of=(x, y)) for solid in solids)


def _find_towards(solid: Solid, origin: FloatArray, azimuth: FloatArray) -> IntArray:
    """Return indices into the ascending `azimuth` of rays from `origin` that may meet a solid."""
    dx, dy = solid.x - origin[0], solid.y - origin[1]
    distance = math.hypot(dx, dy)
    if distance <= solid.radius:
        return np.arange(len(azimuth))
    # A hair more than the tangents, for rounding.
    half = math.asin(solid.radius / distance) + 1e-9
    turns = math.atan2(dy, dx) + np.array([-2.0 * math.pi, 0.0, 2.0 * math.pi])
    starts, ends = (np.searchsorted(azimuth, turns + side) for side in (-half, half))
    return np.concatenate([np.arange(a, b) for a, b in zip(starts, ends, strict=True)])


def standing_box(
    terrain: Terrain, x: float, y: float, size: Size, yaw: float = 0.0, kind: Kind = Kind.BOX
) -> Hull:
    """Box that stands on the terrain."""
    length, width, height = size
    ground, radius = float(terrain.height(x, y)), 0.5 * math.hypot(length, width)
    cos, sin = math.cos(yaw), math.sin(yaw)
    sides = np.array([[cos, sin, 0.0], [-cos, -sin, 0.0], [-sin, cos, 0.0], [sin, -cos, 0.0]])
    limits = 0.5 * np.array([length, length, width, width])
    return Hull(kind, x, y, ground - BURIED_DEPTH, ground + height, radius, sides, limits)


def floating_box(
    terrain: Terrain, x: float, y: float, size: Size, clearance: float, kind: Kind = Kind.OVERHANG
) -> Hull:
    """Box that floats `clearance` [m] over the terrain."""
    bottom = float(terrain.height(x, y)) + clearance
    box = standing_box(terrain, x, y, size, kind=kind)
    return replace(box, bottom=bottom, top=bottom + size[2])


def upright(
    terrain: Terrain, kind: Kind, at: Place, low: float, high: float, radius: float
) -> Cylinder:
    """Cylinder between two heights over the terrain [m]."""
    ground = float(terrain.height(*at))
    return Cylinder(kind, *at, ground + low, ground + high, radius)


def crate(terrain: Terrain, x: float, y: float, height: float, yaw: float = 0.0) -> Solids:
    """Crate, an object of its own."""
    return parts_of(x, y, [standing_box(terrain, x, y, (0.8, 0.6, height), yaw)])


def pole(
    terrain: Terrain, x: float, y: float, height: float = 6.0, radius: float = 0.1
) -> Cylinder:
    """Pole that stands on the terrain."""
    return upright(terrain, Kind.POLE, (x, y), -BURIED_DEPTH, height, radius)


def car(terrain: Terrain, x: float, y: float, yaw: float = 0.0) -> Solids:
    """Car: a body and a cabin."""
    body, cabin = (4.3, 1.8, 0.9), (2.3, 1.6, 1.5)
    return parts_of(x, y, (standing_box(terrain, x, y, size, yaw) for size in (body, cabin)))


def truck(terrain: Terrain, x: float, y: float, yaw: float = 0.0) -> Solids:
    """Truck: a load and a lower cab in front of it."""
    cab_x, cab_y = x + 4.2 * math.cos(yaw), y + 4.2 * math.sin(yaw)
    load = standing_box(terrain, x, y, (6.4, 2.5, 3.6), yaw)
    return parts_of(x, y, (load, standing_box(terrain, cab_x, cab_y, (1.8, 2.3, 2.6), yaw)))


def wall(terrain: Terrain, start: Place, end: Place, height: float) -> tuple[Hull, ...]:
    """Wall from `start` to `end` (x, y) [m], in panels that follow the ground."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    n_panels = max(1, math.ceil(math.hypot(dx, dy) / WALL_PANEL))
    size = (math.hypot(dx, dy) / n_panels, WALL_THICKNESS, height)
    middles = (np.arange(n_panels) + 0.5) / n_panels
    yaw = math.atan2(dy, dx)
    return tuple(
        standing_box(terrain, start[0] + s * dx, start[1] + s * dy, size, yaw, Kind.WALL)
        for s in middles.tolist()
    )


def tree(terrain: Terrain, x: float, y: float) -> Solids:
    """Tree: a trunk and a floating crown."""
    trunk = pole(terrain, x, y, height=3.0, radius=0.18)
    return trunk, floating_box(terrain, x, y, (3.0, 3.0, 3.0), 2.5, Kind.VEGETATION)
