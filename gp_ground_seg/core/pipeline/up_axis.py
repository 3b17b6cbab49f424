"""Stage 2: planes that may be the ground, and whether it lies along another axis than z."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray, Scan
from gp_ground_seg.core.pipeline.ground_plane import FARTHEST, GroundPlane
from gp_ground_seg.core.pipeline.points import Direction, angles_of, rotation, turned_back

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
FEW_CELLS = 45
"""Cells on the plane below which its height is doubtful. Whole scans that show the height have
more; parts of a scan, up to 60 degrees wide, have fewer, or less than `MIN_COVERAGE` of the
sectors."""
CONE_SPREAD = 0.025
"""Spread [rad] below which what looks like a plane is one beam on walls."""
MIN_COVERAGE = 0.25
"""Share of the sectors with ground in them from which a scan determines the tilt."""
MIN_REACH = 5.0
"""Range that the ground must reach for the same [m]."""

MAX_TILT = math.radians(46.0)
"""Angle from an axis within which a plane is searched; such cones about the six axes cover all
directions. A scan whose ground is farther from z than that is not levelled but refused."""
OVERHUNG = 0.75
"""`GroundPlane.overhung` from which a plane may be that of a reflected ceiling."""
STEEP = math.radians(25.0)
"""Tilt from which a plane is fitted again in a frame in which it is level: lowest points of a
tilted frame are not all ground."""
GOOD_SUPPORT = 0.9
"""Support of a `TALL` plane below z under which other axes are tried."""
TALL = 6.0
"""Height from which the plane below z may well be a facade [m]."""
SUPPORT_RATIO = 0.8
"""Least support of another plane over that of the plane below z."""
OTHER_MIN_SUPPORT, OTHER_MIN_REACH = 0.5, 10.0
"""Support, and range that it reaches [m], from which a plane that is not below z shows where the
ground is: walls and ceilings of rooms seldom do."""
CLEAR = 0.3
"""Height from which a return counts as above a plane, or below [m]: over a ceiling, or the ground
seen from a sensor upside down, there is less than below it, and a scan of one beam has neither."""

_QUARTER = math.pi / 2.0
UPRIGHT, *OTHER_AXES = (
    rotation(roll, pitch)
    for roll, pitch in (
        (0.0, 0.0),
        (math.pi, 0.0),
        (_QUARTER, 0.0),
        (-_QUARTER, 0.0),
        (0.0, _QUARTER),
        (0.0, -_QUARTER),
    )
)
"""Rotations (3, 3) that turn z up, and each of the five other axes."""


def is_well_supported(plane: GroundPlane) -> bool:
    """Whether enough of the lowest points lie on a plane to level a scan by it."""
    return plane.support >= MIN_SUPPORT or plane.near_support >= MIN_NEAR_SUPPORT


class View(NamedTuple):
    """A plane of a scan, seen from a frame in which it may be level."""

    plane: GroundPlane
    turn: FloatArray  # (3, 3) rotation to that frame from the one levelled by the parameters
    clearance: float  # how far the plane is below the sensor there [m]
    is_mirror: bool = False  # whether what is below it are mirror images

    @property
    def up(self) -> Direction:
        """Normal of the plane, in the frame levelled by the parameters."""
        return turned_back(self.plane.normal, self.turn)

    @property
    def levelled(self) -> FloatArray:
        """Rotation (3, 3) as `turn`, to a frame in which the plane is level."""
        return rotation(*angles_of(self.up))

    @property
    def may_be_image(self) -> bool:
        """Whether it may be a mirror image, as of the ceiling in a polished floor."""
        return self.plane.overhung >= OVERHUNG or not is_well_supported(self.plane)

    @property
    def is_steep(self) -> bool:
        """Whether the plane is clearly tilted against the frame that it was fitted in."""
        return self.plane.normal[2] < math.cos(STEEP)

    @property
    def is_tall(self) -> bool:
        """Whether the plane may well be a facade."""
        return self.plane.height > TALL

    @property
    def can_level(self) -> bool:
        """Whether it is enough ground to level the scan by, and z not too far from its normal."""
        return self.tells_tilt and self.up[2] >= math.cos(MAX_TILT)

    @property
    def is_surface(self) -> bool:
        """Whether it is ground for sure: seen at several angles, or several rows deep."""
        plane = self.plane
        is_wide = plane.support >= MIN_SUPPORT and plane.coverage >= MIN_COVERAGE
        return plane.n_support >= MIN_CELLS and (
            (self.clearance >= MIN_CLEARANCE and plane.spread >= MIN_SPREAD)
            or (is_wide and plane.depth >= MIN_DEPTH)
        )

    @property
    def is_whole(self) -> bool:
        """Whether so much of it is seen that it is not to be doubted."""
        plane = self.plane
        return self.is_surface and plane.n_support >= FEW_CELLS and plane.coverage >= MIN_COVERAGE

    @property
    def tells_height(self) -> bool:
        """Whether it may be ground; doubtful, unless it is for sure."""
        plane = self.plane
        is_seen = plane.spread >= CONE_SPREAD or not math.isnan(plane.other_height)
        return self.is_surface or (is_seen and self.clearance >= MIN_CLEARANCE)

    @property
    def tells_tilt(self) -> bool:
        """Whether it is enough ground to tell the tilt."""
        plane = self.plane
        return (
            self.is_surface
            and (is_well_supported(plane) or self.is_mirror)
            and plane.coverage >= MIN_COVERAGE
            and plane.reach >= MIN_REACH
        )


def view_of(plane: GroundPlane, scan: Scan, turn: FloatArray, origin: Direction) -> View | None:
    """View of a plane of `scan`, where the sensor is at `origin`; None of a ceiling."""
    clearance = float(plane.below(*origin))
    if clearance < MIN_CLEARANCE and not _is_lower_side(plane, scan):
        return None
    return View(plane, turn, clearance)


def _is_lower_side(plane: GroundPlane, scan: Scan) -> bool:
    """Whether more returns are clearly above the plane than below it."""
    height = plane.below(*scan.xyz[scan.grid.r < FARTHEST].T.astype(np.float64))
    return bool(np.count_nonzero(height > CLEAR) > np.count_nonzero(height < -CLEAR))


def is_doubtful(below: View | None) -> bool:
    """Whether the plane below z is so poor, or so far away, that z may not be up."""
    return (
        below is None
        or below.is_steep
        or not (is_well_supported(below.plane) or below.is_mirror)
        or (below.is_tall and below.plane.support < GOOD_SUPPORT)
    )


def clearest(below: View | None, others: Iterable[View]) -> View | None:
    """Return the one of `others` that clearly is the ground, if `below`, about z, is not."""
    support = SUPPORT_RATIO * below.plane.support if below is not None else 0.0
    found = [
        view
        for view in others
        if view.tells_tilt
        # No ground is above the sensor: roofs of cars, of whose ground little is seen, are.
        and -MIN_CLEARANCE <= view.clearance <= TALL
        and view.plane.support >= max(support, OTHER_MIN_SUPPORT)
        and view.plane.reach >= OTHER_MIN_REACH
    ]
    return max(found, key=lambda view: view.plane.support, default=below)


def refusal(view: View, given: FloatArray) -> str:
    """One line on where the ground is; `given` is the rotation (3, 3) by the parameters."""
    up = given.T @ view.up
    roll, pitch = (round(angle, 3) + 0.0 for angle in angles_of(up))
    largest = int(np.argmax(np.abs(up)))
    axis = f'{"-" if up[largest] < 0.0 else ""}{"xyz"[largest]}'
    tilt = math.degrees(math.acos(min(up[2], 1.0)))
    problem = f'z is tilted by {tilt:.0f} degrees' if axis == 'z' else 'z does not point up'
    height = view.plane.height * view.plane.normal[2]
    return (
        f'{problem}: the ground seems to be {height:.2f} m away with {axis} up; turn '
        f'the cloud, or set sensor.roll to {roll:.3f} and sensor.pitch to {pitch:.3f} [rad]'
    )
