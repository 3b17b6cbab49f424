"""Landforms: flat ground, slope, ramp, kerbs, ditch, crest, rough ground."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.simulation.terrain import Profile, Terrain
from gp_ground_seg.simulation.waves import random_waves


def polyline(
    heading: float,
    points: Sequence[tuple[float, float]],
    slope_before: float = 0.0,
    slope_after: float = 0.0,
) -> Profile:
    """Profile of straight pieces.

    Parameters
    ----------
    heading : float
        Direction of u [rad].
    points : sequence of (u, z)
        Corners in ascending u [m]. Corners with the same u are a vertical step from the
        first to the last of them.
    slope_before, slope_after : float
        Slope before the first and after the last corner.

    Raises
    ------
    ConfigError
        If there is no corner or u descends.
    """
    if not points or any(b[0] < a[0] for a, b in itertools.pairwise(points)):
        raise ConfigError(f'polyline: corners {list(points)}: must be given, in ascending u')
    anchors, coefficients = [points[0][0]], [(points[0][1], slope_before, 0.0)]
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
    """Road between two sidewalks.

    Parameters
    ----------
    half_width : float
        Half the width of the road [m].
    height : float
        Height of the sidewalks over the road [m].
    face_width : float
        Horizontal depth of the kerb's face [m]; 0 is a vertical face.
    heading : float
        Direction across the road [rad].
    """
    outer = half_width + face_width
    corners = [(-outer, height), (-half_width, 0.0), (half_width, 0.0), (outer, height)]
    return polyline(heading, corners)


def ditch(
    start: float, top_width: float, bottom_width: float, depth: float, heading: float = 0.0
) -> Profile:
    """Trapezoidal ditch in level ground, between u = `start` and `start` + `top_width` [m]."""
    side = (top_width - bottom_width) / 2.0
    end = start + top_width
    corners = [(start, 0.0), (start + side, -depth), (end - side, -depth), (end, 0.0)]
    return polyline(heading, corners)


def crest(
    start: float, climb: float, gradient: float, rounding: float, heading: float = 0.0
) -> Profile:
    """Straight climb, rounded top, descent as steep as the climb, level ground on both sides.

    Parameters
    ----------
    start : float
        u where the climb starts [m].
    climb, rounding : float
        Horizontal lengths of the climb (and of the descent) and of the rounded top [m].
    gradient : float
        Slope of the climb.
    heading : float
        Direction of u [rad].
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


def rough(
    rng: np.random.Generator,
    rms: float = 0.08,
    wavelengths: tuple[float, float] = (2.0, 20.0),
    n_waves: int = 8,
) -> Terrain:
    """Ground with waves of `rms` height [m] everywhere; see `random_waves`."""
    return random_waves(rng, rms, wavelengths, n_waves, flat(1.0))


def smooth_then_rough(
    rng: np.random.Generator,
    start: float,
    transition: float,
    rms: float = 0.15,
    wavelengths: tuple[float, float] = (0.8, 6.0),
    n_waves: int = 8,
    heading: float = 0.0,
) -> Terrain:
    """Flat ground that grows rough from u = `start` [m] on, fully so after `transition` [m]."""
    envelope = polyline(heading, [(start, 0.0), (start + transition, 1.0)])
    return random_waves(rng, rms, wavelengths, n_waves, envelope)
