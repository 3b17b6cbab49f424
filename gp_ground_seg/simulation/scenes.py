"""Landforms; named scenes, each built from a seed around a drive along x from the origin."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gp_ground_seg.simulation import objects
from gp_ground_seg.simulation.objects import Solid
from gp_ground_seg.simulation.terrain import Profile, Terrain, Waves

N_WAVES = 8
N_SCATTERED, SCATTER_X, SCATTER_Y = 36, (-60.0, 100.0), (6.0, 35.0)
"""Scattered solids, and their distance from the drive [m], which leaves its lane free."""
URBAN_X = (-80.0, 160.0)  # where the street of the urban scene begins and ends [m]


def rough(
    rng: np.random.Generator,
    rms: float = 0.08,
    wavelengths: tuple[float, float] = (2.0, 20.0),
    envelope: Profile | None = None,
) -> Waves:
    """Ground with waves of random heading and phase, scaled by `envelope` (see `Waves`).

    `rms` [m] is the height of all waves together where the envelope is one. Their lengths [m] are
    evenly spread on a log scale between the two ends; all waves are equally steep.
    """
    shortest, longest = np.log(wavelengths)
    wavelength = np.exp(rng.uniform(shortest, longest, N_WAVES))
    heading = rng.uniform(0.0, 2.0 * np.pi, N_WAVES)
    phase = rng.uniform(0.0, 2.0 * np.pi, N_WAVES)
    k = (2.0 * np.pi / wavelength)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    amplitude = wavelength * rms * np.sqrt(2.0 / np.sum(wavelength**2))
    return Waves(k, amplitude, phase, flat(1.0) if envelope is None else envelope)


def polyline(
    heading: float, points: Sequence[tuple[float, float]], slope_after: float = 0.0
) -> Profile:
    """Profile of straight pieces along `heading` [rad], level before the first corner.

    `points` are the corners (u, z) in ascending u [m]; those of the same u are a vertical step
    from the first to the last of them. `slope_after` is that after the last corner.
    """
    (first_u, first_z), (last_u, last_z) = points[0], points[-1]
    pieces = [(first_u, first_z, 0.0)]
    for (u0, z0), (u1, z1) in itertools.pairwise(points):
        if u1 > u0:
            pieces.append((u0, z0, (z1 - z0) / (u1 - u0)))
    anchor, height, rise = np.array([*pieces, (last_u, last_z, slope_after)]).T
    # A piece ends where the next one begins; one lone vertical step has its one edge at the end.
    return Profile(heading, anchor[1:], anchor, np.column_stack([height, rise, 0.0 * rise]))


def flat(z: float = 0.0) -> Profile:
    """Level ground at height `z` [m]."""
    return slope(0.0, 0.0, z)


def slope(gradient: float, heading: float = 0.0, z: float = 0.0) -> Profile:
    """Plane that rises by `gradient` per metre towards `heading` [rad], `z` [m] at the origin."""
    return Profile(heading, np.empty(0), np.zeros(1), np.array([[z, gradient, 0.0]]))


def ramp(start: float, gradient: float, heading: float = 0.0) -> Profile:
    """Level ground until u = `start` [m], then a plane that rises by `gradient` per metre."""
    return polyline(heading, [(start, 0.0)], slope_after=gradient)


def kerb(
    half_width: float, height: float, face_width: float = 0.05, heading: float = math.pi / 2
) -> Profile:
    """Road between sidewalks, `heading` [rad] across it; a kerb is `face_width` [m] deep."""
    outer = half_width + face_width
    corners = [(-outer, height), (-half_width, 0.0), (half_width, 0.0), (outer, height)]
    return polyline(heading, corners)


def ditch(
    heading: float, start: float, top_width: float, bottom_width: float, depth: float
) -> Profile:
    """Trapezoidal ditch in level ground, from u = `start` to `start` + `top_width` [m]."""
    side = (top_width - bottom_width) / 2.0
    end = start + top_width
    corners = [(start, 0.0), (start + side, -depth), (end - side, -depth), (end, 0.0)]
    return polyline(heading, corners)


def crest(
    start: float, climb: float, gradient: float, rounding: float, heading: float = 0.0
) -> Profile:
    """Climb from u = `start` [m], rounded top, descent as steep; horizontal lengths [m]."""
    top, z, level = start + climb, gradient * climb, (0.0, 0.0, 0.0)
    edges = np.array([start, top, top + rounding, top + rounding + climb])
    up, down = (0.0, gradient, 0.0), (z, -gradient, 0.0)
    coefficients = np.array([level, up, (z, gradient, -gradient / rounding), down, level])
    return Profile(heading, edges, np.array([start, *edges]), coefficients)


def smooth_then_rough(
    rng: np.random.Generator, start: float, transition: float, rms: float = 0.15
) -> Waves:
    """Flat ground that grows rough from x = `start` [m] on, fully so after `transition` [m]."""
    envelope = polyline(0.0, [(start, 0.0), (start + transition, 1.0)])
    return rough(rng, rms, (0.8, 6.0), envelope=envelope)


@dataclass(frozen=True)
class WetPatch:
    """A disc of wet road [m] that mirrors a ray with the probability `reflectivity`."""

    x: float
    y: float
    radius: float
    reflectivity: float = 0.5


@dataclass(frozen=True)
class Scene:
    """Terrain, the solids on it, and wet patches of it."""

    name: str
    terrain: Terrain
    solids: tuple[Solid, ...] = ()
    wet_patches: tuple[WetPatch, ...] = ()


def _scattered(terrain: Terrain, rng: np.random.Generator) -> tuple[Solid, ...]:
    """Cars, trucks, crates, walls, poles and trees on both sides of the drive."""
    solids: list[Solid] = []
    for k in range(N_SCATTERED):
        x = rng.uniform(*SCATTER_X)
        y = rng.uniform(*SCATTER_Y) * rng.choice([-1.0, 1.0])
        yaw = rng.uniform(0.0, 2.0 * math.pi)
        match k % 6:
            case 0 | 1:
                solids += objects.car(terrain, x, y, yaw)
            case 2:
                solids.append(
                    objects.standing_box(terrain, x, y, (0.8, 0.6, rng.uniform(0.3, 1.0)), yaw)
                )
            case 3:
                solids.append(objects.pole(terrain, x, y))
            case 4:
                solids += objects.tree(terrain, x, y)
            case _:
                along = rng.uniform(4.0, 12.0)
                solids += objects.wall(terrain, (x, y), (x + along, y), rng.uniform(1.0, 2.5))
    return tuple(solids)


_OPEN_COUNTRY: dict[str, Callable[[np.random.Generator], Terrain]] = {
    # Level ground.
    'flat': lambda rng: flat(),
    # Plane that rises or falls by 8 % in a random direction.
    'slope': lambda rng: slope(0.08, rng.uniform(-math.pi, math.pi)),
    # Level ground, then at once a climb of 12 %.
    'ramp': lambda rng: ramp(rng.uniform(12.0, 18.0), 0.12, rng.uniform(-0.3, 0.3)),
    # Waves of 2 to 20 m, 8 cm rms.
    'rough': rough,
    # Smooth road that ends in rubble: waves of 0.8 to 6 m, 15 cm rms.
    'road_then_rubble': lambda rng: smooth_then_rough(rng, rng.uniform(14.0, 20.0), 3.0),
    # Road between sidewalks 15 cm higher.
    'kerb': lambda rng: kerb(rng.uniform(3.5, 5.0), 0.15),
    # Ditch 1 m deep across the drive, at an angle.
    'ditch': lambda rng: ditch(rng.uniform(-0.5, 0.5), rng.uniform(10.0, 14.0), 4.0, 1.5, 1.0),
    # Hill of 8 % slopes with a rounded top that hides what is behind it.
    'crest': lambda rng: crest(rng.uniform(8.0, 12.0), 15.0, 0.08, 12.0),
}


def _open_scene(name: str, seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    terrain = _OPEN_COUNTRY[name](rng)
    return Scene(name, terrain, _scattered(terrain, rng))


def _urban(seed: int) -> Scene:
    """Street: kerbs, parked cars, a truck, houses, awnings, poles, trees, a bridge, puddles."""
    rng = np.random.default_rng(seed)
    road, front = 6.0, 10.0
    terrain = kerb(road, 0.15)
    solids: list[Solid] = []
    wet: list[WetPatch] = []
    for side in (-1.0, 1.0):
        x = URBAN_X[0]
        while x < URBAN_X[1]:
            house = rng.uniform(12.0, 25.0)
            ends = (x, side * front), (x + house, side * front)
            solids += objects.wall(terrain, *ends, rng.uniform(4.0, 9.0))
            x += house + rng.uniform(2.0, 8.0)
        for x in np.arange(URBAN_X[0], URBAN_X[1], 9.0) + rng.uniform(0.0, 2.0):
            if rng.random() < 0.6:
                solids += objects.car(terrain, x, side * (road - 1.1), rng.normal(0.0, 0.02))
                wet.append(WetPatch(x + rng.uniform(-3.0, 3.0), side * 2.5, rng.uniform(0.8, 1.8)))
        for x in np.arange(URBAN_X[0], URBAN_X[1], 22.0) + rng.uniform(0.0, 10.0):
            solids.append(objects.pole(terrain, x, side * 7.0))
            solids += objects.tree(terrain, x + 8.0, side * 8.0)
    solids += objects.truck(terrain, rng.uniform(25.0, 35.0), 2.6, math.pi)
    # Low enough for the flat upper beams of an HDL-64E to meet it.
    deck = (5.0, 2.0 * front, 0.8)
    solids.append(objects.floating_box(terrain, rng.uniform(40.0, 50.0), 0.0, deck, 2.8))
    for x in np.arange(URBAN_X[0], URBAN_X[1], 30.0) + rng.uniform(0.0, 20.0):
        solids.append(objects.floating_box(terrain, x, front - 1.0, (6.0, 2.0, 0.2), 2.1))
    solids.append(objects.standing_box(terrain, rng.uniform(10.0, 20.0), -8.0, (0.5, 0.5, 0.4)))
    return Scene('urban', terrain, tuple(solids), tuple(wet))


SCENES: dict[str, Callable[[int], Scene]] = {
    **{name: functools.partial(_open_scene, name) for name in _OPEN_COUNTRY},
    'urban': _urban,
}
"""Builders of the named scenes: seed -> scene."""
