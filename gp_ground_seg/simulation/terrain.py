"""Analytic terrain: height, slope and bend at any point, piece by piece; and landforms of it.

Every terrain is smooth on pieces that lie between parallel break lines. The ray
caster (`raycast`) crosses one piece at a time, so kinks and vertical steps are met
exactly, and within a piece a bound on the bend along the ray keeps its steps safe.
Why no mesh library: heights and labels are to be exact.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.frame import FloatArray

OptionalArray: TypeAlias = FloatArray | None


class Along(NamedTuple):
    """The terrain below points that move along a line; arrays of shape (R,)."""

    height: FloatArray  # [m]
    slope: FloatArray  # change of the height per unit of travel
    bend: FloatArray  # upper bound of its second derivative over the whole piece


class Terrain(ABC):
    """A surface z(x, y); `+` adds two of them."""

    @abstractmethod
    def along(self, at: FloatArray, direction: FloatArray, piece: OptionalArray = None) -> Along:
        """Terrain below points that move.

        Parameters
        ----------
        at : (R, 2) array
            x, y of the points [m].
        direction : (R, 2) array
            dx, dy per unit of travel.
        piece : (R, 2) array, optional
            Points inside the smooth piece to use, continued to `at`; by default the one
            that `at` lies in, on a break line that on its far side.
        """

    @abstractmethod
    def breaks(self) -> FloatArray:
        """Break lines as rows a, b, c of ``a x + b y = c``, (B, 3)."""

    @abstractmethod
    def ceiling(self) -> Terrain:
        """Terrain without waves that is nowhere below this one."""

    def height(self, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
        """Exact height [m] at x, y [m]; scalars or arrays of one shape."""
        at = np.stack(np.broadcast_arrays(x, y), axis=-1).astype(np.float64)
        flat = at.reshape(-1, 2)
        return self.along(flat, np.zeros_like(flat)).height.reshape(at.shape[:-1])

    def gradient(self, at: FloatArray) -> FloatArray:
        """Slope in x and in y at points (R, 2) [m], (R, 2)."""
        by_axis = [self.along(at, np.broadcast_to(axis, at.shape)).slope for axis in np.eye(2)]
        return np.stack(by_axis, axis=-1)

    def __add__(self, other: Terrain) -> Terrain:
        """Terrain whose heights are the sums of the two."""
        return _Sum((*_terms(self), *_terms(other)))


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
        if len(self.edges):
            k = self.piece_index(at if piece is None else piece)
            anchor, (c0, c1, c2) = self.anchor[k], self.coefficients[k].T
        else:
            anchor, (c0, c1, c2) = self.anchor[0], self.coefficients[0]
        v = u - anchor
        return Along(c0 + v * (c1 + v * c2), du * (c1 + 2.0 * c2 * v), 2.0 * c2 * du**2)

    def piece_index(self, at: FloatArray) -> npt.NDArray[np.intp]:
        """Piece in which points (R, 2) lie, (R,)."""
        return np.searchsorted(self.edges, at @ self._axis, side='right')

    def breaks(self) -> FloatArray:
        """Edges of the pieces, (B, 3)."""
        return np.column_stack([np.broadcast_to(self._axis, (len(self.edges), 2)), self.edges])

    def ceiling(self) -> Terrain:
        """Return itself: it has no waves."""
        return self

    @property
    def _axis(self) -> FloatArray:
        return np.array([math.cos(self.heading), math.sin(self.heading)])


@dataclass(frozen=True, eq=False)
class _Sum(Terrain):
    """Sum of terrains."""

    terms: tuple[Terrain, ...]

    def along(self, at: FloatArray, direction: FloatArray, piece: OptionalArray = None) -> Along:
        parts = [term.along(at, direction, piece) for term in self.terms]
        height, slope, bend = (sum(values) for values in zip(*parts, strict=True))
        return Along(np.asarray(height), np.asarray(slope), np.asarray(bend))

    def breaks(self) -> FloatArray:
        return np.unique(np.concatenate([term.breaks() for term in self.terms]), axis=0)

    def ceiling(self) -> Terrain:
        return _Sum(tuple(term.ceiling() for term in self.terms))


def _terms(terrain: Terrain) -> tuple[Terrain, ...]:
    return terrain.terms if isinstance(terrain, _Sum) else (terrain,)


@dataclass(frozen=True, eq=False)
class Waves(Terrain):
    """Sum of n plane waves A sin(k . (x, y) + phase), scaled by an envelope.

    The envelope is never negative, of straight pieces, the two outer ones level; any other
    raises ConfigError.
    """

    wave_vectors: FloatArray  # (n, 2) k [rad/m]
    amplitudes: FloatArray  # (n,) A [m]
    phases: FloatArray  # (n,) [rad]
    envelope: Profile

    def __post_init__(self) -> None:
        """Check that the envelope can be bounded."""
        pieces = self.envelope.coefficients
        bounded = not pieces[:, 2].any() and not pieces[[0, -1], 1].any()
        if not bounded or (self._envelope_ends() < 0.0).any():
            raise ConfigError(
                'envelope of waves: must be >= 0, of straight pieces, the two outer ones level'
            )

    def along(self, at: FloatArray, direction: FloatArray, piece: OptionalArray = None) -> Along:
        """See `Terrain.along`."""
        factor, factor_slope, _ = self.envelope.along(at, direction, piece)
        height, slope, slope_bound, bend_bound = (np.zeros(len(at)) for _ in range(4))
        # A smooth road, most of what a sensor sees, has no waves to add up.
        rough = np.flatnonzero((factor != 0.0) | (factor_slope != 0.0))
        height[rough], slope[rough], slope_bound[rough], bend_bound[rough] = self._full_waves(
            at[rough], direction[rough]
        )
        index = self.envelope.piece_index(at if piece is None else piece)
        largest_factor = self._envelope_ends().max(axis=0)[index]
        return Along(
            factor * height,
            factor * slope + factor_slope * height,
            largest_factor * bend_bound + 2.0 * np.abs(factor_slope) * slope_bound,
        )

    def _full_waves(
        self, at: FloatArray, direction: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Height, slope, and bounds of the sizes of slope and bend, where the envelope is one."""
        x, y = at.T
        dx, dy = direction.T
        height, slope, slope_bound, bend_bound = (np.zeros(len(at)) for _ in range(4))
        waves = zip(self.wave_vectors, self.amplitudes, self.phases, strict=True)
        for (kx, ky), amplitude, phase in waves:
            angle = kx * x + ky * y + phase
            rate = kx * dx + ky * dy
            height += amplitude * np.sin(angle)
            slope += amplitude * rate * np.cos(angle)
            slope_bound += np.abs(amplitude * rate)
            bend_bound += np.abs(amplitude) * rate**2
        return height, slope, slope_bound, bend_bound

    def _envelope_ends(self) -> FloatArray:
        """Envelope at the near and at the far end of each piece, (2, B + 1)."""
        c0, c1, _ = self.envelope.coefficients.T
        edges, anchor = self.envelope.edges, self.envelope.anchor
        near = c0 + c1 * (np.concatenate([anchor[:1], edges]) - anchor)
        far = c0 + c1 * (np.concatenate([edges, anchor[-1:]]) - anchor)
        return np.stack([near, far])

    def breaks(self) -> FloatArray:
        """Edges of the envelope, (B, 3)."""
        return self.envelope.breaks()

    def ceiling(self) -> Terrain:
        """Envelope times the sum of all amplitudes."""
        envelope, total = self.envelope, float(np.abs(self.amplitudes).sum())
        return Profile(
            envelope.heading, envelope.edges, envelope.anchor, envelope.coefficients * total
        )


def rough(
    rng: np.random.Generator,
    rms: float = 0.08,
    wavelengths: tuple[float, float] = (2.0, 20.0),
    n_waves: int = 8,
    envelope: Profile | None = None,
) -> Waves:
    """Ground with waves of random heading and phase.

    Parameters
    ----------
    rng : Generator
        Source of headings, phases and wavelengths.
    rms : float
        Root-mean-square height of all waves together where the envelope is one [m].
    wavelengths : (float, float)
        Shortest and longest [m], evenly spread on a log scale; all waves are equally steep.
    n_waves : int
        Number of waves.
    envelope : Profile, optional
        Factor of the waves (see `Waves`), by default one everywhere.

    Raises
    ------
    ConfigError
        If a value is out of range.
    """
    shortest, longest = wavelengths
    if not (rms >= 0.0 and 0.0 < shortest <= longest and n_waves >= 1):
        raise ConfigError(
            f'waves: rms = {rms} m, wavelengths = {wavelengths} m, n_waves = {n_waves}: '
            'must be rms >= 0, 0 < shortest <= longest, n_waves >= 1'
        )
    wavelength = np.exp(rng.uniform(np.log(shortest), np.log(longest), n_waves))
    heading = rng.uniform(0.0, 2.0 * np.pi, n_waves)
    phase = rng.uniform(0.0, 2.0 * np.pi, n_waves)
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
    if not points or any(b[0] < a[0] for a, b in itertools.pairwise(points)):
        raise ConfigError(f'polyline: corners {list(points)}: must be given, in ascending u')
    anchors, coefficients = [points[0][0]], [(points[0][1], 0.0, 0.0)]
    for (u0, z0), (u1, z1) in itertools.pairwise(points):
        if u1 > u0:
            anchors.append(u0)
            coefficients.append((z0, (z1 - z0) / (u1 - u0), 0.0))
    anchors.append(points[-1][0])
    coefficients.append((points[-1][1], slope_after, 0.0))
    # A piece ends where the next one begins; one lone vertical step has its one edge at the end.
    edges = anchors[1:]
    return Profile(heading, np.array(edges), np.array(anchors), np.array(coefficients))


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
    """Road between two sidewalks `height` [m] above it; `heading` [rad] is across the road.

    `half_width` [m] is of the road, `face_width` [m] the horizontal depth of the kerb's face,
    0 for a vertical one.
    """
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
    """Climb from u = `start` [m], rounded top, descent as steep, level ground on both sides.

    `climb` [m] is the horizontal length of the climb and of the descent, `rounding` [m] that of
    the top.
    """
    top, end = start + climb, start + climb + rounding
    edges = np.array([start, top, end, end + climb])
    z = gradient * climb
    coefficients = [
        (0.0, 0.0, 0.0),
        (0.0, gradient, 0.0),
        (z, gradient, -gradient / rounding),
        (z, -gradient, 0.0),
        (0.0, 0.0, 0.0),
    ]
    return Profile(heading, edges, np.array([start, *edges]), np.array(coefficients))


def smooth_then_rough(
    rng: np.random.Generator, start: float, transition: float, rms: float = 0.15
) -> Waves:
    """Flat ground that grows rough from x = `start` [m] on, fully so after `transition` [m]."""
    envelope = polyline(0.0, [(start, 0.0), (start + transition, 1.0)])
    return rough(rng, rms, (0.8, 6.0), envelope=envelope)
