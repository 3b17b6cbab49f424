"""Stage 2: whether a plane is ground, and whether the ground lies along another axis than z."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.pipeline.ground_plane import GroundPlane
from gp_ground_seg.core.pipeline.tilt import Direction, angles_of, rotation

MIN_SUPPORT = 0.35
"""Share of the lowest points on the plane from which a scan determines the tilt."""
MIN_NEAR_SUPPORT = 0.5
"""Share of their weight that does as well: on a dike most of them lie below it, far away."""
MIN_CELLS = 12
"""Points on the plane from which a scan determines the height."""
MIN_CLEARANCE, MIN_SPREAD = 0.05, 0.06
"""Height of the sensor over the plane [m], and spread of the angles of depression of these points
[rad], for the same: more than one beam."""
MIN_DEPTH = 2.5
"""Points on it one behind the other (`GroundPlane.depth`) that do without both: the lowest beam on
walls, or a scan of one beam, gives one or two, 2.3 in a corridor; ground gives three and more."""
SHALLOW, SHALLOW_SPREAD = 2.0, 0.03
"""The same of ground that is seen at angles so far apart [rad], as the floor of a small room: one
beam on walls is seen at one."""
MIN_COVERAGE = 0.25
"""Share of the sectors with ground in them from which a scan determines the tilt."""
MIN_REACH = 5.0
"""Range that the ground must reach for the same [m]."""

UP_MAX_TILT = math.radians(46.0)
"""Angle from each axis within which up is searched; these cones cover all directions. A scan whose
up lies in that of z is levelled, another refused."""
GOOD_SUPPORT = 0.9
"""Support of a `TALL` plane below z under which other axes are tried."""
TALL = 6.0
"""Height from which the plane below z may well be a facade [m]."""
UP_MIN_SUPPORT = 0.5
"""Support from which a plane that is not below z shows where the ground is."""
UP_SUPPORT_RATIO, UP_SUPPORT_RATIO_TALL = 2.0, 0.8
"""Least support of another plane over that of the plane below z: near, and `TALL`."""
UP_DISTANCE_RATIO = 3.0
"""Distance of a `TALL` plane over the largest of another one."""
UP_FIRST_SUPPORT = 0.15
"""Support from which a plane is fitted again in its own level frame."""
UP_STEEP = math.radians(25.0)
"""Tilt of the plane below z from which a better one is looked for in its own level frame: that
plane may have stopped at `MAX_TILT`."""
UP_MIN_CELLS = 60
"""Lowest points that must exist for another plane to count."""
UP_MIN_FAR_COVERAGE = 0.5
"""Share of the sectors in which it must reach far: the ceiling of a room does not."""

_QUARTER = math.pi / 2.0
_AXES = (
    (0.0, 0.0),
    (math.pi, 0.0),
    (_QUARTER, 0.0),
    (-_QUARTER, 0.0),
    (0.0, _QUARTER),
    (0.0, -_QUARTER),
)
"""Roll and pitch that turn each of the six axes up [rad]."""


def is_well_supported(plane: GroundPlane) -> bool:
    """Whether enough of the lowest points lie on a plane to level a scan by it."""
    return plane.support >= MIN_SUPPORT or plane.near_support >= MIN_NEAR_SUPPORT


class View(NamedTuple):
    """The plane of the ground, seen from a frame in which it is about level."""

    plane: GroundPlane
    up: Direction  # its normal, in the frame levelled by the parameters
    is_below: bool  # whether it lies below the sensor

    @property
    def tells_height(self) -> bool:
        """Whether it is ground for sure."""
        plane = self.plane
        is_seen_from_above = self.is_below and plane.spread >= MIN_SPREAD
        is_floor = self.is_below and plane.spread >= SHALLOW_SPREAD and plane.depth >= SHALLOW
        return plane.n_support >= MIN_CELLS and (
            is_seen_from_above
            or (
                plane.support >= MIN_SUPPORT
                and plane.coverage >= MIN_COVERAGE
                and (plane.depth >= MIN_DEPTH or is_floor)
            )
        )

    @property
    def tells_tilt(self) -> bool:
        """Whether it is enough ground to level the scan by."""
        plane = self.plane
        return (
            self.tells_height
            and is_well_supported(plane)
            and plane.coverage >= MIN_COVERAGE
            and plane.reach >= MIN_REACH
        )


Look = Callable[[FloatArray | None, float], View | None]
"""Returns the plane of the scan rotated by a matrix (3, 3), tilted there by an angle at most."""


def is_up_axis_doubtful(plane: GroundPlane | None) -> bool:
    """Whether the plane below z is so poor, or so far away, that z may not be up."""
    return (
        plane is None
        or not is_well_supported(plane)
        or _is_steep(plane)
        or (_is_tall(plane) and plane.support < GOOD_SUPPORT)
    )


def _is_steep(plane: GroundPlane) -> bool:
    return plane.normal[2] < math.cos(UP_STEEP)


def _is_tall(plane: GroundPlane | None) -> bool:
    return plane is not None and plane.height > TALL


def _is_ground(view: View, support: float) -> bool:
    plane = view.plane
    if plane.support < support or plane.n_cells < UP_MIN_CELLS:
        return False
    if view.up[2] >= math.cos(UP_MAX_TILT):
        return view.tells_tilt
    return (
        view.tells_height
        and plane.support >= UP_MIN_SUPPORT
        and plane.coverage >= MIN_COVERAGE
        and plane.far_coverage >= UP_MIN_FAR_COVERAGE
    )


def find_up_axis(plane: GroundPlane | None, look: Look) -> View | None:
    """Return the ground where it clearly lies, if the `plane` below z is not it, or None."""
    support = 0.0 if plane is None or _is_steep(plane) else plane.support
    ratio = UP_SUPPORT_RATIO_TALL if _is_tall(plane) else UP_SUPPORT_RATIO
    needed = ratio * support
    farthest = (
        plane.height / UP_DISTANCE_RATIO if plane is not None and _is_tall(plane) else math.inf
    )
    found = []
    for angles in _AXES:
        first = look(rotation(*angles), UP_MAX_TILT)
        if first is None or first.plane.support < UP_FIRST_SUPPORT:
            continue
        # Fit again with that plane level: lowest points of a tilted frame are not all ground.
        view = look(rotation(*angles_of(first.up)), UP_MAX_TILT)
        if view is not None and view.plane.height <= farthest and _is_ground(view, needed):
            found.append(view)
    return max(found, key=lambda view: view.plane.support * view.plane.far_coverage, default=None)


def refusal(view: View, given: FloatArray) -> str:
    """One line on where the ground is; `given` is the rotation (3, 3) by the parameters."""
    up = given.T @ view.up
    roll, pitch = (round(angle, 3) + 0.0 for angle in angles_of(up))
    largest = int(np.argmax(np.abs(up)))
    axis = f'{"-" if up[largest] < 0.0 else ""}{"xyz"[largest]}'
    height = view.plane.height * view.plane.normal[2]
    return (
        f'z does not point up: the ground seems to be {height:.2f} m away with {axis} up; turn '
        f'the cloud, or set sensor.roll to {roll:.3f} and sensor.pitch to {pitch:.3f} [rad]'
    )
