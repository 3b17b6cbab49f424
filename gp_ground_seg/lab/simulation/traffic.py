"""Vehicles with bonnets, windscreens and wheels; persons and cyclists."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gp_ground_seg.lab.simulation import objects
from gp_ground_seg.lab.simulation.objects import Kind, Solids
from gp_ground_seg.lab.simulation.terrain import Place, Terrain

Corners = tuple[Place, ...]


class Model(NamedTuple):
    """A vehicle seen from its right side; lengths in metres, the front ahead."""

    length: float
    width: float
    bodies: tuple[tuple[float, Corners], ...]
    """Width of each part, and corners (ahead of the middle, above the ground) of its convex
    outline, counter-clockwise."""
    axles: tuple[float, ...]  # ahead of the middle
    wheel: float  # radius


MODELS = {
    'saloon': Model(
        4.5, 1.8,
        ((1.8, ((-2.25, 0.3), (-1.9, 0.2), (2.0, 0.2), (2.25, 0.35), (2.25, 0.65), (2.0, 0.8),
                (0.95, 0.98), (-1.7, 1.02), (-2.2, 0.95))),
         (1.5, ((-1.75, 0.9), (1.05, 0.9), (0.2, 1.4), (-0.2, 1.45), (-0.8, 1.42))),),
        (1.35, -1.35), 0.32,
    ),
    'hatchback': Model(
        3.9, 1.7,
        ((1.7, ((-1.95, 0.3), (-1.7, 0.2), (1.7, 0.2), (1.95, 0.35), (1.95, 0.65), (1.75, 0.85),
                (0.95, 1.0), (-1.9, 1.0))),
         (1.45, ((-1.9, 0.9), (1.05, 0.9), (0.3, 1.42), (-0.1, 1.5), (-1.3, 1.47))),),
        (1.2, -1.2), 0.3,
    ),
    'suv': Model(
        4.7, 1.9,
        ((1.9, ((-2.35, 0.4), (-2.0, 0.25), (2.1, 0.25), (2.35, 0.45), (2.35, 0.85), (2.1, 1.02),
                (1.0, 1.15), (-2.3, 1.15))),
         (1.6, ((-2.3, 1.05), (1.1, 1.05), (0.45, 1.6), (0.0, 1.7), (-1.9, 1.68))),),
        (1.4, -1.4), 0.36,
    ),
    'van': Model(
        5.3, 2.0,
        ((2.0, ((-2.65, 0.35), (2.4, 0.25), (2.65, 0.4), (2.65, 0.85), (2.4, 1.05), (1.6, 1.2),
                (-2.65, 1.2))),
         (1.9, ((-2.65, 1.1), (1.85, 1.1), (1.05, 2.05), (0.6, 2.2), (-2.6, 2.2))),),
        (1.7, -1.6), 0.35,
    ),
    'truck': Model(
        8.6, 2.5,
        ((2.5, ((-4.3, 1.05), (2.1, 1.05), (2.1, 3.6), (-4.3, 3.6))),
         (2.3, ((2.35, 0.4), (4.3, 0.4), (4.3, 1.4), (4.1, 2.6), (3.6, 2.8), (2.35, 2.8))),
         (0.9, ((-4.2, 0.7), (2.5, 0.7), (2.5, 1.1), (-4.2, 1.1))),),
        (3.2, -2.6), 0.5,
    ),
}  # fmt: skip
"""Vehicles by name."""
WHEEL_WIDTH = 0.2


def is_even(terrain: Terrain, x: float, y: float) -> bool:
    """Whether a car can stand at a place: the ground is no steeper than 0.3, and hardly bent."""
    half = 2.3
    around = terrain.height(x + half * np.array([1, 0, -1, 0]), y + half * np.array([0, 1, 0, -1]))
    bend = float(np.mean(around) - terrain.height(x, y))
    return bool(np.ptp(around) < 0.3 * 2.0 * half and abs(bend) < 0.1)


def vehicle(terrain: Terrain, name: str, x: float, y: float, yaw: float = 0.0) -> Solids:
    """Vehicle, one of `MODELS`, leaning with the terrain at its middle."""
    model = MODELS[name]
    parts = [_extruded(terrain, (x, y, yaw), corners, w, 0.0) for w, corners in model.bodies]
    turns = np.arange(8) * (math.pi / 4.0) + math.pi / 8.0
    r = model.wheel
    for axle, side in itertools.product(model.axles, (-1.0, 1.0)):
        circle = tuple((axle + r * math.cos(t), r + r * math.sin(t)) for t in turns.tolist())
        aside = side * 0.5 * (model.width - WHEEL_WIDTH - 0.04)
        parts.append(_extruded(terrain, (x, y, yaw), circle, WHEEL_WIDTH, aside))
    return objects.parts_of(x, y, parts)


def _extruded(
    terrain: Terrain,
    pose: tuple[float, float, float],
    corners: Sequence[Place],
    width: float,
    aside: float,
) -> objects.Hull:
    """Solid of a side view and a width, its middle `aside` [m] to the left of that of `pose`."""
    x, y, yaw = pose
    ground = float(terrain.height(x, y))
    slope_x, slope_y = terrain.gradient(np.array([[x, y]]))[0].tolist()
    ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    left = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    above = np.array([-slope_x, -slope_y, 1.0])  # times a point: its height over the terrain
    normals, limits = [left, -left], [0.5 * width + aside, 0.5 * width - aside]
    for (u0, z0), (u1, z1) in itertools.pairwise((*corners, corners[0])):
        normals.append((z1 - z0) * ahead + (u0 - u1) * above)
        limits.append((z1 - z0) * u0 + (u0 - u1) * (z0 + ground))
    u, z = np.array(corners).T
    radius = math.hypot(float(np.abs(u).max()), 0.5 * width + abs(aside))
    rise = radius * math.hypot(slope_x, slope_y)
    bottom, top = ground + float(z.min()) - rise, ground + float(z.max()) + rise
    return objects.Hull(Kind.BOX, x, y, bottom, top, radius, np.array(normals), np.array(limits))


def person(terrain: Terrain, x: float, y: float) -> Solids:
    """Person 1.7 m tall: legs, trunk and head."""
    parts = (0.0, 0.85, 0.13), (0.8, 1.45, 0.22), (1.4, 1.7, 0.1)
    body = [objects.upright(terrain, Kind.PERSON, (x, y), *part) for part in parts]
    return objects.parts_of(x, y, body)


def cyclist(terrain: Terrain, x: float, y: float) -> Solids:
    """Cyclist 1.75 m tall: the bicycle, legs, trunk and head."""
    sizes = (0.0, (1.7, 0.06, 0.68)), (0.3, (0.5, 0.32, 0.65))
    boxes = [objects.floating_box(terrain, x, y, size, low, Kind.CYCLIST) for low, size in sizes]
    parts = ((0.9, 1.5, 0.2), (1.45, 1.75, 0.11))
    rider = [objects.upright(terrain, Kind.CYCLIST, (x, y), *part) for part in parts]
    return objects.parts_of(x, y, (*boxes, *rider))
