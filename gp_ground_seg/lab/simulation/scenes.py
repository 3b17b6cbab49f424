"""Named scenes, each built from a seed around a drive along x from the origin."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator

from gp_ground_seg.lab.scoring.objects import LOW_HEIGHTS
from gp_ground_seg.lab.simulation import objects, traffic
from gp_ground_seg.lab.simulation import terrain as landforms
from gp_ground_seg.lab.simulation.objects import Kind, Solid
from gp_ground_seg.lab.simulation.terrain import Place, Terrain, ditch, flat, polyline, ramp, rough

Span = tuple[float, float]  # the least and the largest distance [m]
N_SCATTERED, SCATTER_X, SCATTER_Y = 36, (-60.0, 100.0), (6.0, 35.0)
"""Scattered solids, and their distance from the drive [m], which leaves its lane free."""
CARS = ('saloon', 'hatchback', 'suv')
MIXED = (*CARS, *CARS, 'van', 'van', 'truck')
"""Models of vehicles, among which the parked and the waiting ones are drawn."""
LOW_DISTANCE, LOW_GAP = (3.0, 20.0), 0.03
"""Distance of the nearest corner of a low object [m], and angle between neighbours [rad]."""
N_OF_EACH, APART = 4, 5.5
"""Cars, persons, crates, poles and walls around a vehicle, and least distance of two [m]."""
CRATES = 0.4, 0.65  # heights of the crates that are objects [m]
ENDS = -15.0, -8.0, 8.0, 15.0  # places of persons and crates along a valley or a dike [m]
LEANING = 'hills', 'on_ramp'  # scenes in which the vehicle leans with the ground
BANKS = tuple(np.radians((15.0, 25.0, 35.0)).tolist())  # slopes of banks [rad]
URBAN_X = (-80.0, 160.0)  # where the street of the urban scene begins and ends [m]


@dataclass(frozen=True)
class WetPatch:
    """A disc of wet road [m] that mirrors a ray with the probability `reflectivity`."""

    x: float
    y: float
    radius: float
    reflectivity: float = 0.5
    is_deep: bool = False  # whether a mirrored ray that meets nothing has no return


@dataclass(frozen=True)
class Scene:
    """Terrain, the solids on it, and wet patches of it."""

    name: str
    terrain: Terrain
    solids: tuple[Solid, ...] = ()
    wet_patches: tuple[WetPatch, ...] = ()
    leans: bool = False  # whether the vehicle leans with the ground under it, or is level


Parts = Iterator[Any]  # the terrain of a scene, then the solids on it and its wet patches


def _open(make: Callable[[Generator], Terrain], rng: Generator) -> Parts:
    """Terrain with cars, crates, walls, poles and trees on both sides of the drive."""
    yield (terrain := make(rng))
    for k in range(N_SCATTERED):
        x = rng.uniform(*SCATTER_X)
        y = rng.uniform(*SCATTER_Y) * rng.choice([-1.0, 1.0])
        yaw = rng.uniform(0.0, 2.0 * math.pi)
        match k % 6:
            case 0 | 1:
                yield from objects.car(terrain, x, y, yaw)
            case 2:
                size = (0.8, 0.6, rng.uniform(0.3, 1.0))
                yield objects.standing_box(terrain, x, y, size, yaw)
            case 3:
                yield objects.pole(terrain, x, y)
            case 4:
                yield from objects.tree(terrain, x, y)
            case _:
                along = rng.uniform(4.0, 12.0)
                yield from objects.wall(terrain, (x, y), (x + along, y), rng.uniform(1.0, 2.5))


_OPEN_COUNTRY: dict[str, Callable[[Generator], Terrain]] = {
    # Level ground.
    'flat': lambda rng: flat(),
    # Plane that rises or falls by 8 % in a random direction.
    'slope': lambda rng: landforms.slope(0.08, rng.uniform(-math.pi, math.pi)),
    # Level ground, then at once a climb of 12 %.
    'ramp': lambda rng: ramp(rng.uniform(12.0, 18.0), 0.12, rng.uniform(-0.3, 0.3)),
    # Waves of 2 to 20 m, 8 cm rms.
    'rough': rough,
    # Smooth road that ends in rubble: waves of 0.8 to 6 m, 15 cm rms.
    'road_then_rubble': lambda rng: landforms.smooth_then_rough(rng, rng.uniform(14.0, 20.0), 3.0),
    # Road between sidewalks 15 cm higher.
    'kerb': lambda rng: landforms.kerb(rng.uniform(3.5, 5.0), 0.15),
    # Ditch 1 m deep across the drive, at an angle.
    'ditch': lambda rng: ditch(rng.uniform(-0.5, 0.5), rng.uniform(10.0, 14.0), 4.0, 1.5, 1.0),
    # Hill of 8 % slopes with a rounded top that hides what is behind it.
    'crest': lambda rng: landforms.crest(rng.uniform(8.0, 12.0), 15.0, 0.08, 12.0),
}


def _urban(rng: Generator) -> Parts:
    """Street: kerbs, parked cars, a truck, houses, awnings, poles, trees, a bridge, puddles."""
    road, front = 6.0, 10.0
    yield (terrain := landforms.kerb(road, 0.15))
    for side in (-1.0, 1.0):
        x = URBAN_X[0]
        while x < URBAN_X[1]:
            house = rng.uniform(12.0, 25.0)
            ends = (x, side * front), (x + house, side * front)
            yield from objects.wall(terrain, *ends, rng.uniform(4.0, 9.0))
            x += house + rng.uniform(2.0, 8.0)
        for x in np.arange(URBAN_X[0], URBAN_X[1], 9.0) + rng.uniform(0.0, 2.0):
            if rng.random() < 0.6:
                yield from objects.car(terrain, x, side * (road - 1.1), rng.normal(0.0, 0.02))
                yield WetPatch(x + rng.uniform(-3.0, 3.0), side * 2.5, rng.uniform(0.8, 1.8))
        for x in np.arange(URBAN_X[0], URBAN_X[1], 22.0) + rng.uniform(0.0, 10.0):
            yield objects.pole(terrain, x, side * 7.0)
            yield from objects.tree(terrain, x + 8.0, side * 8.0)
    yield from objects.truck(terrain, rng.uniform(25.0, 35.0), 2.6, math.pi)
    # Low enough for the flat upper beams of an HDL-64E to meet it.
    deck = (5.0, 2.0 * front, 0.8)
    yield objects.floating_box(terrain, rng.uniform(40.0, 50.0), 0.0, deck, 2.8)
    for x in np.arange(URBAN_X[0], URBAN_X[1], 30.0) + rng.uniform(0.0, 20.0):
        yield objects.floating_box(terrain, x, front - 1.0, (6.0, 2.0, 0.2), 2.1)
    yield objects.standing_box(terrain, rng.uniform(10.0, 20.0), -8.0, (0.5, 0.5, 0.4))


@dataclass(frozen=True)
class _Line:
    """A line of vehicles along `heading` [rad], `aside` [m] to the left of the origin."""

    terrain: Terrain
    rng: Generator
    heading: float
    aside: float

    def at(self, along: float, aside: float = 0.0) -> Place:
        """x, y [m] of a place."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        aside += self.aside
        return along * cos - aside * sin, along * sin + aside * cos

    def fill(
        self,
        ends: Span,
        gaps: Span,
        turned: float = 0.0,
        models: Sequence[str] = MIXED,
        share: float = 1.0,
    ) -> tuple[list[Solid], list[float]]:
        """Vehicles from one end [m] to the other, and the places of the gaps between them.

        `turned` [rad] is their yaw against the line, `share` that of the places taken.
        """
        solids: list[Solid] = []
        free: list[float] = []
        along, sign = ends[0], math.copysign(1.0, ends[1] - ends[0])
        while sign * (ends[1] - along) > 10.0:
            name, gap = str(self.rng.choice(models)), self.rng.uniform(*gaps)
            length, width, *_ = traffic.MODELS[name]
            size = width if abs(math.sin(turned)) > 0.5 else length
            x, y = self.at(along + sign * (gap + 0.5 * size), self.rng.uniform(-0.15, 0.15))
            yaw = self.heading + turned + self.rng.normal(0.0, 0.02)
            if self.rng.random() < share:
                solids += traffic.vehicle(self.terrain, name, x, y, yaw)
            free.append(along + sign * 0.5 * gap)
            along += sign * (gap + size)
        return solids, free


def _traffic_jam(rng: Generator) -> Parts:
    """Five lanes of waiting vehicles between kerbs, cyclists between them, persons who cross."""
    yield (terrain := landforms.kerb(8.2, 0.15))
    with_truck = rng.choice([-1, 1])
    for lane in range(-2, 3):
        line = _Line(terrain, rng, 0.0, 3.2 * lane)
        nearest = 2.4 if lane == 0 else rng.uniform(-2.0, 1.0)
        if lane == with_truck:
            x, y = line.at(nearest + 5.5)
            yield from traffic.vehicle(terrain, 'truck', x, y)
        ahead = nearest + 9.9 if lane == with_truck else nearest
        turned = math.pi if lane == 2 else 0.0
        for ends in ((ahead, 70.0), (-abs(nearest), -60.0)):
            made, gaps = line.fill(ends, (1.2, 3.0), turned)
            yield from made
            for along in gaps[1:]:
                if rng.random() < 0.12:
                    yield from traffic.person(terrain, *line.at(along, rng.uniform(-1.0, 1.0)))
        if lane < 2:
            for x in rng.uniform((-25.0, 3.0), (-3.0, 25.0)).tolist():
                yield from traffic.cyclist(terrain, x, 3.2 * lane + 1.6)
    for side in (-1.0, 1.0):
        yield from objects.wall(terrain, (-60.0, side * 13.0), (70.0, side * 13.0), 7.0)
        for x in np.arange(-25.0, 25.0, 10.0) + rng.uniform(0.0, 8.0):
            yield from traffic.person(terrain, x, side * rng.uniform(9.0, 12.0))


def _car_park(rng: Generator) -> Parts:
    """Rows of parked cars, 0.6 to 1 m apart, along aisles 6 m wide with persons in them."""
    yield (terrain := landforms.slope(rng.uniform(0.0, 0.02), rng.uniform(-math.pi, math.pi)))
    for aside, side in itertools.product((5.5, 10.6, 21.5, 26.6), (-1.0, 1.0)):
        line = _Line(terrain, rng, 0.0, side * aside)
        turned = rng.choice([-1.0, 1.0]) * math.pi / 2.0
        yield from line.fill((-45.0, 55.0), (0.6, 1.0), turned, CARS, share=0.88)[0]
    for x in (-12.0, -7.5, 3.0, 7.5, 12.0, 16.5, 21.0, 25.5):
        place = x + rng.uniform(0.0, 3.0), rng.uniform(-2.6, 2.6)
        yield from traffic.person(terrain, *place)


def _hidden_climb(rng: Generator) -> Parts:
    """Parked cars in a row, and right behind it a street that climbs by 10 to 15 %."""
    heading, near = rng.uniform(-math.pi, math.pi), rng.uniform(4.5, 6.5)
    foot, gradient = near + rng.uniform(1.5, 2.5), rng.uniform(0.1, 0.15)
    yield (terrain := polyline(heading, [(foot, 0.0), (foot + 50.0, 50.0 * gradient)]))
    row = _Line(terrain, rng, heading - math.pi / 2.0, near)
    yield from row.fill((-28.0, 34.0), (0.6, 1.2), models=CARS)[0]
    for k in range(10):
        beside = 4.0 * k - 18.0 + rng.uniform(-0.7, 0.7)
        place = row.at(beside, foot - near + rng.uniform(8.0, 35.0))
        if k % 2:
            yield from traffic.person(terrain, *place)
        else:
            name, yaw = str(rng.choice(CARS)), heading + rng.normal(0.0, 0.1)
            yield from traffic.vehicle(terrain, name, *place, yaw)


def _wet_road(rng: Generator) -> Parts:
    """Traffic jam in the rain: of the near returns of ground a third is missing or mirrored."""
    yield from _traffic_jam(rng)
    yield WetPatch(0.0, 0.0, 20.0, 0.35, True)


def _blind_slope(rng: Generator) -> Terrain:
    """Slope of 10 to 15 % around a level place 2 to 3 m wide: it begins in the blind spot."""
    gradient, half = rng.uniform(0.1, 0.15), rng.uniform(1.0, 1.5)
    rise = 40.0 * gradient
    corners = [(-half - 40.0, -rise), (-half, 0.0), (half, 0.0), (half + 40.0, rise)]
    return polyline(rng.uniform(-math.pi, math.pi), corners)


def _hedge(rng: Generator) -> Parts:
    """Path between dense hedges 0.5 to 0.8 m high, with a fence behind one of them."""
    yield (terrain := rough(rng, 0.02, (1.5, 10.0)))
    side = rng.choice([-1.0, 1.0])
    for y in (side * rng.uniform(3.0, 6.0), -side * rng.uniform(3.0, 6.0)):
        high, deep = rng.uniform(0.55, 0.75), rng.uniform(0.6, 1.2)
        for x in np.arange(-30.0, 50.0, 0.25).tolist():
            # Leaves stick out by some centimetres.
            size = (0.27, deep + rng.uniform(-0.15, 0.15), high + rng.uniform(-0.05, 0.05))
            at = x, y + rng.uniform(-0.05, 0.05)
            yield objects.standing_box(terrain, *at, size, kind=Kind.VEGETATION)
    fence = side * rng.uniform(8.0, 10.0)
    for x in np.arange(-40.0, 60.0, 2.0).tolist():
        yield objects.pole(terrain, x, fence, 1.3, 0.05)
        for clearance in (0.52, 0.82, 1.12):
            yield objects.floating_box(terrain, x + 1.0, fence, (2.0, 0.04, 0.12), clearance)
    yield from traffic.person(terrain, rng.uniform(5.0, 15.0), rng.uniform(-1.0, 1.0))


def _around(
    smooth: Terrain, waves: Terrain, rng: Generator, reach: Span, places: Sequence[Place] = ()
) -> Parts:
    """Terrain with small `waves`, and cars, persons, crates, poles and walls in a `reach` [m].

    Cars are where `smooth`, the terrain without the waves, is even, and lean with it. There are a
    person and a crate in turns at `places` (x, y) [m] as well.
    """
    yield (terrain := landforms.Sum((smooth, waves)))
    for k, place in enumerate(places):
        crate = objects.crate(terrain, *place, rng.uniform(*CRATES))
        yield from crate if k % 2 else traffic.person(terrain, *place)
    taken = [*places]
    while (k := len(taken) - len(places)) < 5 * N_OF_EACH:
        away, bearing, yaw = rng.uniform(*reach), *rng.uniform(-math.pi, math.pi, 2)
        x, y = away * math.cos(bearing), away * math.sin(bearing)
        if any(math.dist((x, y), place) < APART for place in taken):
            continue
        match k // N_OF_EACH:
            case 0:
                if not traffic.is_even(smooth, x, y):
                    continue
                yield from traffic.vehicle(smooth, str(rng.choice(CARS)), x, y, yaw)
            case 1:
                yield from traffic.person(terrain, x, y)
            case 2:
                yield from objects.crate(terrain, x, y, rng.uniform(*CRATES), yaw)
            case 3:
                yield objects.pole(terrain, x, y)
            case _:
                dx, dy = 2.5 * math.cos(yaw), 2.5 * math.sin(yaw)
                ends = (x - dx, y - dy), (x + dx, y + dy)
                yield from objects.wall(terrain, *ends, rng.uniform(1.0, 2.5))
        taken.append((x, y))


def _hills(rng: Generator) -> Parts:
    """Waves of 14 to 45 m, 0.9 m rms, and of 1 to 5 m, 4 cm rms, on which the vehicle leans."""
    smooth = rough(rng, 0.9, (14.0, 45.0))
    yield from _around(smooth, rough(rng, 0.04, (1.0, 5.0)), rng, (6.0, 32.0))


def _valley(rng: Generator) -> Parts:
    """Level floor 6 to 10 m wide between sides of 15 to 25 degrees that are 6 m high."""
    floor, gradient = rng.uniform(3.0, 5.0), math.tan(math.radians(rng.uniform(15.0, 25.0)))
    top = floor + 6.0 / gradient
    corners = [(-top, 6.0), (-floor, 0.0), (floor, 0.0), (top, 6.0)]
    heading = rng.uniform(-math.pi, math.pi)
    smooth = polyline(heading, corners)
    waves = rough(rng, 0.03, (1.0, 6.0))
    along = _Line(smooth, rng, heading - 0.5 * math.pi, 0.0)
    places = [along.at(k, rng.uniform(-0.6, 0.6) * floor) for k in ENDS]
    yield from _around(smooth, waves, rng, (6.0, 24.0), places)


def _bank(slope: float, rng: Generator) -> Parts:
    """Bank of a slope [rad], 2.5 to 4.5 m high, with persons and crates on it."""
    heading, gradient = rng.uniform(-math.pi, math.pi), math.tan(slope)
    foot, rise = rng.uniform(9.0, 14.0), rng.uniform(2.5, 4.5)
    depth = rise / gradient
    smooth = polyline(heading, [(foot, 0.0), (foot + depth, rise)])
    waves = rough(rng, 0.02, (1.0, 8.0))
    middle = _Line(smooth, rng, heading - 0.5 * math.pi, foot + 0.5 * depth)
    places = [middle.at(k, rng.uniform(-0.25, 0.25) * depth) for k in (-10.0, -3.5, 3.5, 10.0)]
    yield from _around(smooth, waves, rng, (6.0, 32.0), places)


def _on_ramp(rng: Generator) -> Parts:
    """Ramp of 15 to 25 %, 9 to 17 m long, between level ground; the vehicle stands on it."""
    gradient, behind, ahead = rng.uniform((0.15, 4.0, 5.0), (0.25, 8.0, 9.0)).tolist()
    corners = [(-behind, -gradient * behind), (ahead, gradient * ahead)]
    smooth = polyline(rng.uniform(-math.pi, math.pi), corners)
    yield from _around(smooth, rough(rng, 0.01, (1.0, 8.0)), rng, (6.0, 28.0))


def _dike(rng: Generator) -> Parts:
    """Dike 5 to 8 m wide, 1 to 2 m above the ground on both sides; the vehicle stands on it."""
    heading, gradient = rng.uniform(-math.pi, math.pi), rng.uniform(0.4, 0.7)
    half, high = rng.uniform(2.5, 4.0), rng.uniform(1.0, 2.0)
    foot = half + high / gradient
    smooth = polyline(heading, [(-foot, -high), (-half, 0.0), (half, 0.0), (foot, -high)])
    waves = rough(rng, 0.02, (1.0, 8.0))
    along = _Line(smooth, rng, heading - 0.5 * math.pi, 0.0)
    places = [along.at(k, rng.uniform(-0.6, 0.6) * half) for k in ENDS]
    yield from _around(smooth, waves, rng, (6.0, 32.0), places)


def _low_box(rng: Generator) -> objects.Size:
    """Size of a box, half of them 0.44 m wide, the others up to 2 m by 2 m."""
    length, width = rng.uniform(0.8, 2.0, 2) if rng.random() < 0.5 else (0.44, 0.44)
    return length, width, float(rng.choice(LOW_HEIGHTS))


def _low(
    ground: str, kind: Kind, size: Callable[[Generator], objects.Size], rng: Generator
) -> Parts:
    """Low objects all around the sensor, turned at random, each in plain view."""
    yield (terrain := _OPEN_COUNTRY[ground](rng))
    start = bearing = rng.uniform(-math.pi, math.pi)
    while True:
        length, width, height = size(rng)
        turned = rng.uniform(-1.0, 1.0) * (0.5 * math.pi)
        cos, sin, near = math.cos(turned), abs(math.sin(turned)), rng.uniform(*LOW_DISTANCE)
        half = math.atan2(0.5 * (length * cos + width * sin), near)
        if bearing + 2.0 * half + LOW_GAP > start + 2.0 * math.pi:
            return
        middle, away = bearing + half, near + 0.5 * (length * sin + width * cos)
        x, y, yaw = away * math.cos(middle), away * math.sin(middle), middle + 0.5 * math.pi
        box = objects.standing_box(terrain, x, y, (length, width, height), yaw + turned, kind)
        yield from objects.parts_of(x, y, [box])
        bearing += 2.0 * half + LOW_GAP


def _build(name: str, make: Callable[[Generator], Parts], seed: int) -> Scene:
    """Make a scene of a seed."""
    terrain, *parts = make(np.random.default_rng(seed))
    solids = tuple(part for part in parts if isinstance(part, Solid))
    wet = tuple(part for part in parts if isinstance(part, WetPatch))
    return Scene(name, terrain, solids, wet, name in LEANING)


def _named(**makers: Callable[[Generator], Parts]) -> dict[str, Callable[[int], Scene]]:
    """Functions of a seed, by the names of their scenes."""
    return {name: partial(_build, name, make) for name, make in makers.items()}


DRIVES = _named(
    **{name: partial(_open, make) for name, make in _OPEN_COUNTRY.items()}, urban=_urban
)
"""Scenes whose lane along x is free, by name."""
LOW = _named(
    low_boxes=partial(_low, 'flat', Kind.BOX, _low_box),
    low_boxes_rough=partial(_low, 'rough', Kind.BOX, _low_box),
    lying_persons=partial(_low, 'flat', Kind.PERSON, lambda rng: (1.7, 0.45, 0.22)),
)
"""Scenes of low objects."""
STEEP = {
    **_named(hills=_hills, valley=_valley),
    # Seeds take turns with the slopes.
    'bank': lambda seed: _build('bank', partial(_bank, BANKS[seed % len(BANKS)]), seed),
    **_named(on_ramp=_on_ramp, dike=_dike),
}
"""Scenes of steep ground."""
PLACES = {
    **_named(
        traffic_jam=_traffic_jam, car_park=_car_park, hidden_climb=_hidden_climb,
        wet_road=_wet_road, blind_slope=partial(_open, _blind_slope), hedge=_hedge,
    ),
    **LOW, **STEEP,
}  # fmt: skip
"""All scenes around a sensor at the origin."""
SCENES = {**DRIVES, **PLACES}  # all scenes by name
