"""Analytic terrain: height, slope and bend at any point, landforms, and where rays meet them.

Every terrain is smooth on pieces between parallel break lines, which rays cross one by one, so
that kinks and vertical steps are met exactly. Within a piece the clearance f(t) of a ray has a
second derivative of at least -K, with K the terrain's bend bound. So f(t + s) >= f + f' s -
K s^2 / 2, and the root of that parabola is the largest step that is sure not to pass a crossing.
Why no mesh library: heights and labels are to be exact.
"""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from gp_ground_seg.core.frame import FloatArray

OptionalArray: TypeAlias = FloatArray | None
Place: TypeAlias = tuple[float, float]  # two coordinates [m]
N_WAVES = 8
TOLERANCE = 1e-9  # height at which a ray has met the terrain; length of an empty piece [m]


class Along(NamedTuple):
    """The terrain below points that move along a line; arrays of shape (R,)."""

    height: FloatArray  # [m]
    slope: FloatArray  # change of the height per unit of travel
    bend: FloatArray  # upper bound of its second derivative over the whole piece


class Terrain(ABC):
    """A surface z(x, y)."""

    @abstractmethod
    def along(self, at: FloatArray, direction: FloatArray, piece: OptionalArray = None) -> Along:
        """Terrain below points `at` (R, 2) [m] that move by `direction` (R, 2).

        `piece`, (R, 2), are points inside the smooth piece to use, continued to `at`; by default
        the one that `at` lies in, on a break line that on its far side.
        """

    @abstractmethod
    def breaks(self) -> FloatArray:
        """Break lines as rows a, b, c of ``a x + b y = c``, (B, 3)."""

    def height(self, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
        """Exact height [m] at x, y [m]; scalars or arrays of one shape."""
        at = np.stack(np.broadcast_arrays(x, y), axis=-1).astype(np.float64)
        flat = at.reshape(-1, 2)
        return self.along(flat, np.zeros_like(flat)).height.reshape(at.shape[:-1])

    def gradient(self, at: FloatArray) -> FloatArray:
        """Slope in x and in y at points (R, 2) [m], (R, 2)."""
        by_axis = [self.along(at, np.broadcast_to(axis, at.shape)).slope for axis in np.eye(2)]
        return np.stack(by_axis, axis=-1)


@dataclass(frozen=True, eq=False)
class Profile(Terrain):
    """Terrain that changes along one heading only: parabolas between parallel break lines.

    Over u = x cos(heading) + y sin(heading), piece k reaches up to ``edges[k]`` and is
    z = c0 + c1 (u - anchor) + c2 (u - anchor)^2.
    """

    heading: float  # direction of u [rad]
    edges: FloatArray  # (B,) ascending u of the break lines [m]
    anchor: FloatArray  # (B + 1,) reference u of each piece [m]
    coefficients: FloatArray  # (B + 1, 3) c0 [m], c1, c2 [1/m] of each piece

    def along(self, at: FloatArray, direction: FloatArray, piece: OptionalArray = None) -> Along:
        """See `Terrain.along`."""
        axis = self._axis
        u, du = at @ axis, direction @ axis
        inside = at if piece is None else piece
        k = np.searchsorted(self.edges, inside @ axis, side='right')
        v, (c0, c1, c2) = u - self.anchor[k], self.coefficients[k].T
        return Along(c0 + v * (c1 + v * c2), du * (c1 + 2.0 * c2 * v), 2.0 * c2 * du**2)

    def breaks(self) -> FloatArray:
        """Edges of the pieces, (B, 3)."""
        return np.column_stack([np.broadcast_to(self._axis, (len(self.edges), 2)), self.edges])

    @property
    def _axis(self) -> FloatArray:
        return np.array([math.cos(self.heading), math.sin(self.heading)])


@dataclass(frozen=True, eq=False)
class Waves(Terrain):
    """Sum of n plane waves A sin(k . (x, y) + phase), times an envelope: 0 to 1, no parabolas."""

    wave_vectors: FloatArray  # (n, 2) k [rad/m]
    amplitudes: FloatArray  # (n,) A [m]
    phases: FloatArray  # (n,) [rad]
    envelope: Profile

    def along(self, at: FloatArray, direction: FloatArray, piece: OptionalArray = None) -> Along:
        """See `Terrain.along`."""
        factor, factor_slope, _ = self.envelope.along(at, direction, piece)
        (x, y), (dx, dy), (kx, ky) = at.T, direction.T, self.wave_vectors.T[:, :, None]
        angle, rate = kx * x + ky * y + self.phases[:, None], kx * dx + ky * dy  # (n, R)
        amplitude = self.amplitudes[:, None]
        # Wave by wave, where the envelope is one; with bounds of the sizes of slope and bend.
        height = sum(amplitude * np.sin(angle))
        slope = sum(amplitude * rate * np.cos(angle))
        slope_bound = sum(np.abs(amplitude * rate))
        bend_bound = sum(np.abs(amplitude) * rate**2)
        largest = np.where(factor_slope == 0.0, factor, 1.0)  # of the envelope on the way
        return Along(
            factor * height,
            factor * slope + factor_slope * height,
            largest * bend_bound + 2.0 * np.abs(factor_slope) * slope_bound,
        )

    def breaks(self) -> FloatArray:
        """Edges of the envelope, (B, 3)."""
        return self.envelope.breaks()


@dataclass(frozen=True, eq=False)
class Sum(Terrain):
    """Terrains on top of one another: their heights are added."""

    parts: tuple[Terrain, ...]

    def along(self, at: FloatArray, direction: FloatArray, piece: OptionalArray = None) -> Along:
        """See `Terrain.along`."""
        columns = zip(*(part.along(at, direction, piece) for part in self.parts), strict=True)
        return Along(*(np.sum(column, axis=0) for column in columns))

    def breaks(self) -> FloatArray:
        """Break lines of all parts, (B, 3)."""
        return np.concatenate([part.breaks() for part in self.parts])


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


def polyline(heading: float, points: Sequence[Place], slope_after: float = 0.0) -> Profile:
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


def crest(start: float, climb: float, gradient: float, rounding: float) -> Profile:
    """Climb from x = `start` [m], rounded top, descent as steep; horizontal lengths [m]."""
    top, z, level = start + climb, gradient * climb, (0.0, 0.0, 0.0)
    edges = np.array([start, top, top + rounding, top + rounding + climb])
    up, down = (0.0, gradient, 0.0), (z, -gradient, 0.0)
    coefficients = np.array([level, up, (z, gradient, -gradient / rounding), down, level])
    return Profile(0.0, edges, np.array([start, *edges]), coefficients)


def smooth_then_rough(rng: np.random.Generator, start: float, transition: float) -> Waves:
    """Flat ground that grows rough from x = `start` [m] on, fully so after `transition` [m]."""
    envelope = polyline(0.0, [(start, 0.0), (start + transition, 1.0)])
    return rough(rng, 0.15, (0.8, 6.0), envelope=envelope)


def first_hit(
    terrain: Terrain, origin: FloatArray, direction: FloatArray, max_range: float
) -> FloatArray:
    """Range [m] at which each ray (R, 3) first meets the terrain, infinite beyond `max_range`."""
    hit, ray = np.full(len(origin), np.inf), np.arange(len(origin))
    ends = _piece_ends(terrain, origin, direction, max_range)
    t, piece = np.zeros(len(ray)), np.zeros(len(ray), np.intp)
    while len(ray):
        rows = np.arange(len(ray))
        end = ends[rows, piece]
        debris = end - t < TOLERANCE
        middle = 0.5 * (np.where(piece > 0, ends[rows, piece - 1], 0.0) + end)
        o, d = origin[ray], direction[ray]
        at, inside = (o[:, :2] + s[:, None] * d[:, :2] for s in (t, middle))
        height, slope, bend = terrain.along(at, d[:, :2], inside)
        clearance = o[:, 2] + t * d[:, 2] - height
        met = (clearance <= TOLERANCE) & ~debris
        hit[ray[met]] = t[met]

        step = _safe_step(clearance, d[:, 2] - slope, np.maximum(bend, 0.0))
        leaves = debris | (t + step >= end)
        t = np.where(leaves, end, t + step)
        piece = piece + leaves
        keep = ~met & (piece < ends.shape[1])
        ray, t, piece, ends = ray[keep], t[keep], piece[keep], ends[keep]
    return hit


def _safe_step(clearance: FloatArray, rate: FloatArray, bend: FloatArray) -> FloatArray:
    """Smallest positive root s of clearance + rate s - bend s^2 / 2, infinite if none."""
    root = np.sqrt(rate**2 + 2.0 * bend * np.maximum(clearance, 0.0))
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        # Two forms of one root; each loses no digits for its sign of the rate.
        falling = 2.0 * clearance / (root - rate)
        rising = (rate + root) / bend
    step = np.where(rate < 0.0, falling, rising)
    return np.where(np.isnan(step), np.inf, step)


def _piece_ends(
    terrain: Terrain, origin: FloatArray, direction: FloatArray, max_range: float
) -> FloatArray:
    """Ranges at which each ray leaves pieces, ascending, the last `max_range`, (R, B + 1)."""
    a, b, c = terrain.breaks().T
    rate = direction[:, :1] * a + direction[:, 1:2] * b
    distance = c - (origin[:, :1] * a + origin[:, 1:2] * b)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        crossing = distance / rate
    ahead = (crossing > 0.0) & (crossing < max_range)
    last = np.full((len(rate), 1), max_range)
    return np.sort(np.hstack([np.where(ahead, crossing, max_range), last]), axis=1)
