"""Stage 2: height and tilt of the sensor over the ground near it, from one scan (docs/pose.md)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Optional

import numpy as np

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.frame import Candidates, FloatArray, PointArray, Scan
from gp_ground_seg.parameters.config import SensorConfig
from gp_ground_seg.parameters.schema import AUTO
from gp_ground_seg.pipeline.ground_plane import GroundPlane
from gp_ground_seg.pipeline.tilt import (
    Direction,
    angles_of,
    rotate,
    rotation,
    rounded,
    vertical,
)

FitPlane = Callable[[Candidates, float, Direction], GroundPlane | None]
ScanRotated = Callable[[FloatArray], Scan]

DEFAULT_HEIGHT = 1.73
"""Height where `sensor.height` is auto and the scan does not determine it: a car's roof [m]."""
CLEAR_TILT = 0.05
"""Tilt from which roll and pitch that are auto level the scan [rad]: camber and a vehicle's own
lean stay below it."""
MAX_TILT = math.radians(30.0)
"""Steepest ground plane that is searched [rad]."""

MIN_SUPPORT = 0.35
"""Share of the lowest points on the plane from which a scan determines the tilt."""
MIN_CELLS = 12
"""Points on the plane from which a scan determines the height."""
MIN_CLEARANCE, MIN_SPREAD = 0.05, 0.06
"""Height of the sensor over the plane [m], and spread of the angles of depression of these points
[rad], for the same: more than one beam."""
MIN_DEPTH = 2.5
"""Points on it one behind the other (`GroundPlane.depth`) that do without both: the lowest beam on
walls, or a scan of one beam, gives one or two, 2.3 in a corridor; ground gives three and more."""
ABOVE, MIN_ABOVE = 0.3, 0.01
"""Height over a plane [m], and share of the points higher than that over ground: over a ceiling, a
scan of one beam, or the ground seen from a sensor upside down there are none."""
MIN_COVERAGE = 0.25
"""Share of the sectors with ground in them from which a scan determines the tilt."""
MIN_REACH = 5.0
"""Range that the ground must reach for the same [m]."""
LEAST_COSINE = 0.1
"""Cosine of the tilt from which the sensor's z axis meets the ground."""
HEIGHT_CONTRADICTION = 0.3
"""Difference to a given height from which the scan contradicts it [m]."""
TILT_CONTRADICTION = 0.15
"""Tilt left under given angles from which the scan contradicts them [rad]: no usual slope."""

UP_MAX_TILT = math.radians(46.0)
"""Angle from each axis within which up is searched; these cones cover all directions."""
POOR_SUPPORT, GOOD_SUPPORT = 0.35, 0.9
"""Support of the plane below z under which other axes are tried: near, and `TALL`."""
TALL = 6.0
"""Height from which the plane below z may well be a facade [m]."""
UP_MIN_SUPPORT = 0.5
"""Support from which a plane shows where the ground is."""
UP_SUPPORT_RATIO, UP_SUPPORT_RATIO_TALL = 2.0, 0.8
"""Least support of another plane over that of the plane below z: near, and `TALL`."""
UP_DISTANCE_RATIO = 3.0
"""Distance of a `TALL` plane over the largest of another one."""
UP_FIRST_SUPPORT = 0.15
"""Support from which a plane is fitted again in its own level frame."""
UP_LEVELLED_TILT = math.radians(45.0)
"""Tilt of a plane found so up to which the scan is levelled, and beyond it refused."""
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


@dataclass(frozen=True)
class MeasuredPose:
    """What one scan says of the sensor, whatever was given."""

    # of the cloud's origin over the ground plane, along the vertical of the pose used [m]
    height: float
    roll: float  # angle that would make the ground plane level [rad]
    pitch: float  # as `roll`
    tells_height: bool  # whether the scan shows enough ground for the height
    tells_tilt: bool  # the same for the tilt
    # in the frame levelled by the angles given, or where that is far from level in its own
    plane: GroundPlane


@dataclass(frozen=True)
class SensorPose:
    """Where the sensor was taken to be; the level frame has its origin and heading.

    Attributes
    ----------
    height : float
        Height of the cloud's origin above the ground near it, negative below it [m].
    roll, pitch : float
        Fixed-axis angles that turn the sensor frame level, as those of a URDF [rad]:
        positive roll lifts the left side, positive pitch lowers the nose (REP-103).
    height_estimated, roll_estimated, pitch_estimated : bool
        Whether each comes from this scan rather than from the parameters or a default.
    measured : MeasuredPose or None
        What the scan says; None if it shows no plane at all.
    contradictions : tuple of str
        Parameters that the scan clearly contradicts, a line for each; they are used as given.
    is_height_default : bool
        Whether the height is neither given nor shown by the scan.
    """

    height: float
    roll: float
    pitch: float
    height_estimated: bool = False
    roll_estimated: bool = False
    pitch_estimated: bool = False
    measured: MeasuredPose | None = None
    contradictions: tuple[str, ...] = ()
    is_height_default: bool = False

    @property
    def is_level(self) -> bool:
        """Whether the level frame is the sensor's own."""
        return self.roll == 0.0 and self.pitch == 0.0

    @property
    def rotation(self) -> FloatArray:
        """Matrix (3, 3) from the sensor frame to the level frame."""
        return rotation(self.roll, self.pitch)

    def level(self, xyz: PointArray) -> PointArray:
        """Points (N, 3) of the sensor frame in the level frame; `xyz` itself without tilt."""
        return xyz if self.is_level else rotate(xyz, self.rotation)

    def ground_z(self, z: PointArray, height: FloatArray) -> FloatArray:
        """Height of the surface along the sensor's z axis, sensor frame, (N,) float64 [m].

        `z`, in the sensor frame, and the vertical `height` over the surface are those of the
        points, (N,) [m]. Exact where the surface is level in the level frame; NaN if the axis
        lies within 6 degrees of the horizontal: it does not meet the ground.
        """
        cosine = math.cos(self.roll) * math.cos(self.pitch)
        if abs(cosine) < LEAST_COSINE:
            return np.full_like(height, np.nan)
        below: FloatArray = z - height / cosine
        return below


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
        return plane.n_support >= MIN_CELLS and (
            is_seen_from_above
            or (
                plane.support >= MIN_SUPPORT
                and plane.coverage >= MIN_COVERAGE
                and plane.depth >= MIN_DEPTH
            )
        )

    @property
    def tells_tilt(self) -> bool:
        """Whether it is enough ground to level the scan by."""
        plane = self.plane
        return (
            self.tells_height
            and plane.support >= MIN_SUPPORT
            and plane.coverage >= MIN_COVERAGE
            and plane.reach >= MIN_REACH
        )


Look = Callable[[Optional[FloatArray], float], Optional[View]]
"""Returns the plane of the scan rotated by a matrix (3, 3), tilted there by an angle at most."""


@lru_cache(maxsize=4)
def given_pose(sensor: SensorConfig) -> SensorPose:
    """Pose by the parameters alone: angles that are auto 0, a height that is auto the default."""
    return SensorPose(
        DEFAULT_HEIGHT if sensor.height == AUTO else sensor.height,
        0.0 if sensor.roll == AUTO else sensor.roll,
        0.0 if sensor.pitch == AUTO else sensor.pitch,
        is_height_default=sensor.height == AUTO,
    )


def estimate_pose(
    scan: Scan, sensor: SensorConfig, fit_plane: FitPlane, scan_rotated: ScanRotated
) -> SensorPose:
    """Estimate what is auto, and check what is not against the scan.

    Parameters
    ----------
    scan : Scan
        Points in the frame levelled by `given_pose`.
    sensor : SensorConfig
        Parameters.
    fit_plane : callable
        See `gp_ground_seg.pipeline.ground_plane.fit_plane`.
    scan_rotated : callable
        Returns the same scan, rotated further by a matrix (3, 3); called only where z does not
        seem to be up.

    Raises
    ------
    PointCloudError
        If roll or pitch is auto and z is clearly not up.
    """
    given = given_pose(sensor)
    origin = given.rotation @ (sensor.origin_x, sensor.origin_y, sensor.origin_z)

    def look(turn: FloatArray | None, max_tilt: float) -> View | None:
        own = scan if turn is None else scan_rotated(turn)
        x, y, z = (origin if turn is None else turn @ origin).tolist()
        plane = fit_plane(own.candidates, math.tan(max_tilt), (x, y, z))
        if plane is None:
            return None
        is_below = float(plane.below(x, y, z)) >= MIN_CLEARANCE
        if not is_below and not _has_returns_above(plane, own.xyz):
            return None
        return View(plane, plane.normal if turn is None else _turned_back(plane.normal, turn), is_below)

    view = look(None, MAX_TILT)
    not_up = None
    if is_up_axis_doubtful(None if view is None else view.plane):
        found = find_up_axis(None if view is None else view.plane, look)
        if found is not None and found.up[2] >= math.cos(UP_LEVELLED_TILT):
            view = found
        elif found is not None:
            not_up = _refusal(found, given.rotation)
            if AUTO in (sensor.roll, sensor.pitch):
                raise PointCloudError(not_up)
    contradictions = () if not_up is None else (not_up,)
    if view is None:
        return dataclasses.replace(given, contradictions=contradictions)
    plane, own_up = view.plane, view.up
    tells_height, tells_tilt = view.tells_height, view.tells_tilt
    up = own_up if given.is_level else _turned_back(own_up, given.rotation)
    roll, pitch = _levelled(up, sensor)
    levelled = vertical(roll, pitch)
    corrects = tells_tilt and _angle(levelled, vertical(given.roll, given.pitch)) >= CLEAR_TILT
    # Along the vertical of the pose used, not across the plane.
    along = _product(levelled, up) if corrects else own_up[2]
    if not corrects:
        roll, pitch = given.roll, given.pitch
    height = rounded(plane.near_height * plane.normal[2] / along)
    own_roll, own_pitch = angles_of(up)
    measured = MeasuredPose(height, own_roll, own_pitch, tells_height, tells_tilt, plane)
    estimates_height = sensor.height == AUTO and tells_height
    return SensorPose(
        height=height if estimates_height else given.height,
        roll=roll,
        pitch=pitch,
        height_estimated=estimates_height,
        roll_estimated=sensor.roll == AUTO and corrects,
        pitch_estimated=sensor.pitch == AUTO and corrects,
        measured=measured,
        contradictions=contradictions or _contradictions(sensor, measured, own_up),
        is_height_default=sensor.height == AUTO and not tells_height,
    )


def _has_returns_above(plane: GroundPlane, xyz: PointArray) -> bool:
    with np.errstate(over='ignore', invalid='ignore'):
        height = plane.below(*xyz.T)
    return bool(np.count_nonzero(height > ABOVE) > MIN_ABOVE * len(xyz))


def _turned_back(up: Direction, matrix: FloatArray) -> Direction:
    x, y, z = (matrix.T @ up).tolist()
    return x, y, z


def _levelled(up: Direction, sensor: SensorConfig) -> tuple[float, float]:
    """Roll and pitch [rad] that turn `up` upwards as far as those given allow."""
    roll = rounded(math.atan2(up[1], up[2])) if sensor.roll == AUTO else sensor.roll
    if sensor.pitch != AUTO:
        return roll, sensor.pitch
    across = up[1] * math.sin(roll) + up[2] * math.cos(roll)
    return roll, rounded(math.atan2(-up[0], across))


def _product(a: Direction, b: Direction) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _angle(a: Direction, b: Direction) -> float:
    return math.acos(min(max(_product(a, b), -1.0), 1.0))


def _contradictions(
    sensor: SensorConfig, measured: MeasuredPose, up: Direction
) -> tuple[str, ...]:
    """What of the parameters is clearly wrong; `up` is that of the ground, as they level it."""
    found = []
    if measured.tells_height and measured.plane.support >= MIN_SUPPORT and sensor.height != AUTO:
        difference = abs(sensor.height - measured.height)
        if difference > max(HEIGHT_CONTRADICTION, 0.1 * abs(sensor.height)):
            side = 'below' if measured.height >= 0.0 else 'above'
            found.append(
                f'sensor.height = {sensor.height:g}: the ground near the sensor is '
                f"{abs(measured.height):.2f} m {side} the cloud's origin"
            )
    if measured.tells_tilt and math.acos(min(up[2], 1.0)) > TILT_CONTRADICTION:
        names = [n for n in ('roll', 'pitch') if getattr(sensor, n) != AUTO]
        if names:
            words = ', '.join(f'sensor.{name} = {getattr(sensor, name):g}' for name in names)
            found.append(
                f'{words}: the ground near the sensor is level with roll = '
                f'{measured.roll:.3f}, pitch = {measured.pitch:.3f}'
            )
    return tuple(found)


def is_up_axis_doubtful(plane: GroundPlane | None) -> bool:
    """Whether the plane below z is so poor, or so far away, that z may not be up."""
    return (
        plane is None
        or plane.support < POOR_SUPPORT
        or (_is_tall(plane) and plane.support < GOOD_SUPPORT)
    )


def _is_tall(plane: GroundPlane | None) -> bool:
    return plane is not None and plane.height > TALL


def _is_ground(view: View, support: float) -> bool:
    plane = view.plane
    if plane.support < support or plane.n_cells < UP_MIN_CELLS or not view.tells_height:
        return False
    if view.up[2] >= math.cos(UP_LEVELLED_TILT):
        return view.tells_tilt
    return plane.coverage >= MIN_COVERAGE and plane.far_coverage >= UP_MIN_FAR_COVERAGE


def find_up_axis(plane: GroundPlane | None, look: Look) -> View | None:
    """Return the ground where it clearly lies, if the `plane` below z is not it; None otherwise."""
    support = 0.0 if plane is None else plane.support
    ratio = UP_SUPPORT_RATIO_TALL if _is_tall(plane) else UP_SUPPORT_RATIO
    needed = max(UP_MIN_SUPPORT, ratio * support)
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


def _refusal(view: View, given: FloatArray) -> str:
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
