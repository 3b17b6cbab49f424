"""Stage 2: what a plane of a scan tells: the height, the tilt, or that z is not up."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray, Scan
from gp_ground_seg.core.pipeline.ground_plane import GroundPlane
from gp_ground_seg.core.pipeline.lowest_points import FARTHEST, N_SECTORS, tolerance_at
from gp_ground_seg.core.pipeline.points import angles_of, rotation

MIN_SUPPORT = 0.35
"""Share of the lowest points on the plane from which a scan determines the tilt."""
MIN_CLEARANCE, MIN_SPREAD = 0.05, 0.06
"""Height of the sensor over the plane [m], and spread of the angles of depression of these points
[rad], for the same: more than one beam."""
MIN_DEPTH = 2.5
"""Points on it one behind the other, on average, that do without both: the lowest beam on walls
gives one or two, 2.3 in a corridor; ground gives three and more."""
FEW_CELLS = 45
"""Cells on the plane below which its height is doubtful: parts of a scan, up to 60 degrees wide,
have fewer, or less than `MIN_COVERAGE` of the sectors."""
UNDERCUT = 0.1
"""`GroundPlane.undercut` below which a plane of `FEW_CELLS` needs no `MIN_SUPPORT`: in jams it is
0, on hills 0.6 and more."""
MIN_COVERAGE = 0.25
"""Share of the sectors with ground in them from which a scan determines the tilt."""

OVERHUNG = 0.75
"""`GroundPlane.overhung` from which a plane may be that of a reflected ceiling."""

MAX_TILT = math.radians(46.0)
"""Angle from an axis within which a plane is searched; such cones about the six axes cover all
directions. A scan whose ground is farther from z than that is not levelled but refused."""
STEEP = math.radians(25.0)
"""Tilt from which a plane is fitted again in a frame in which it is level: lowest points of a
tilted frame are not all ground."""
SHEER, FAR, CLEARLY, LEAST_EVIDENCE = 1.0, 6.0, 1.5, 20.0
"""`GroundPlane.depression` [rad] from which a plane may be a facade beside a sensor on its side:
upright sensors see ground at up to 0.8. Reach of another plane over its height: ceilings up to 4.
Its `View.evidence`, over that of the one about z or over the least, to be the ground."""
LEAST_DEPRESSION, STEEP_DEPRESSION = 0.105, 0.2
"""Angle to the plane at which a sensor sees the nearest of it, at least, and at which no vehicle's
origin at its axles does [rad]: a sensor on its roof seems to see it at 0.05 to 0.16 from there."""
LOW = 0.2
"""Height of the sensor below which the plane that it is over may be a table top [m]."""
ONE_ANGLE = 0.05
"""Distance of the quartiles of the steepest angles to returns in all sectors, over the upper one,
up to which a sensor is at the origin: 0.02 of a Mid-360, 0.1 and more from axles on hills."""
CLEAR = 0.3
"""Height from which a return counts as above a plane, or below [m]: over a ceiling, or the ground
seen from a sensor upside down, there is less than below it; a field, or one beam, has neither."""

FLOOR_SCATTER = 0.04
"""Distance of the quartiles of the heights of what is on a plane, up to which it is a floor [m]: 0
to 0.033 in rooms and corridors; walls and lower ends of things mostly have 0.044 and more."""
CUT_TILT, CUT_REACH = 0.08, 20.0
"""Largest tilt [rad] of a plane of lower ends, and range of the points that show it [m]."""
EDGE = 0.2
"""Height of such a plane over the lowest candidate, at most [m]: of uncut scans outdoors 0.2 to 30
but on even ground. With few beams things end as much higher than the cut."""
LAYERS, ALL_AROUND = (0.01, 0.05, 0.1, 0.2), 0.35
"""Heights over the lowest candidate of layers of returns [m]: what ends at a cut has about as many
at all heights. Share of the sectors with candidates that have one in the third, at least: 0.4 to 1
of cut clouds, up to 0.31 of rough paths with a few hollows."""
LOWEST_SHARE, LEAST_SHARE, MOST_SHARE = 0.06, 0.1, 0.7
"""Least share of the third layer that is in the first: cut clouds mostly have 0.06 to 0.33, uneven
ground 0 to 0.05. Shares of the third in the second, and of the fourth in the third: cut clouds
mostly have 0.11 to 0.7, level ground up to 0.04 or from 0.75 on."""
FEW_FLAT, MOST_FLAT = 0.36, 0.7
"""Share of the cells on the plane, of those with several returns, that are no higher than the
third layer, from which it may be ground that scatters, and is ground: roads with a gutter have
0.96, cut clouds 0 to 0.65, but hedges cut where the lowest of few beams end on them."""
LOWER_ENDS = (
    'the lowest returns are the lower ends of objects: the ground is not seen, or was cut away '
    'before, by a crop box or a pass-through filter'
)
FAR_OFF, TINY, HUGE, UNEQUAL = 10.0, 0.5, 200.0, 4.0
"""Range of the nearest hundredth of the returns [m] from which the origin is not the sensor. Range
of nearly all [m] below which a cloud is not in metres; of half of them, above which it is not, if
the farthest are four times as far as the nearest: those of a distant scan are as far."""

UPRIGHT, *OTHER_AXES = (
    rotation(0.5 * math.pi * roll, 0.5 * math.pi * pitch)
    for roll, pitch in ((0, 0), (2, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
)
"""Rotations (3, 3) that turn z up, and each of the five other axes."""


class View(NamedTuple):
    """A plane of a scan, seen from a frame in which it may be level."""

    plane: GroundPlane
    turn: FloatArray  # (3, 3) rotation to that frame from the one levelled by the parameters
    is_mirror: bool | None = None  # whether what is below it are mirror images; None: not asked

    @property
    def up(self) -> FloatArray:
        """Normal of the plane, (3,), in the frame levelled by the parameters."""
        up: FloatArray = self.turn.T @ self.plane.normal
        return up

    @property
    def is_steep(self) -> bool:
        """Whether the plane is clearly tilted against the frame that it was fitted in."""
        return bool(self.plane.normal[2] < math.cos(STEEP))

    @property
    def is_well_supported(self) -> bool:
        """Whether enough of the lowest points lie on it to level a scan by it."""
        has_none_below = self.is_whole and self.plane.undercut < UNDERCUT
        return self.plane.support >= MIN_SUPPORT or has_none_below or bool(self.is_mirror)

    @property
    def evidence(self) -> float:
        """Cells on it, times their share, times how flatly it is seen: facades are seen sheer."""
        return self.plane.n_support * self.plane.support * math.cos(self.plane.depression)

    @property
    def is_dry(self) -> bool:
        """Whether it is known to have no mirror images, and to be none of a polished ceiling."""
        is_no_image = self.plane.overhung < OVERHUNG and self.plane.support >= MIN_SUPPORT
        return self.is_mirror is False and is_no_image

    @property
    def is_surface(self) -> bool:
        """Whether it is ground for sure: seen at several angles, or several rows deep."""
        plane = self.plane
        has_none_below = plane.n_support >= FEW_CELLS and plane.undercut < UNDERCUT
        is_wide = has_none_below or plane.support >= MIN_SUPPORT
        is_spread = plane.height >= MIN_CLEARANCE and plane.spread >= MIN_SPREAD
        depth = plane.n_support / (plane.coverage * N_SECTORS)
        return is_spread or (is_wide and plane.coverage >= MIN_COVERAGE and depth >= MIN_DEPTH)

    @property
    def is_whole(self) -> bool:
        """Whether so much of it is seen that it is not doubtful."""
        plane = self.plane
        return self.is_surface and plane.n_support >= FEW_CELLS and plane.coverage >= MIN_COVERAGE

    @property
    def tells_height(self) -> bool:
        """Whether it may be ground: for sure, or below the sensor."""
        return self.is_surface or self.plane.height >= MIN_CLEARANCE

    @property
    def tells_tilt(self) -> bool:
        """Whether it is enough ground to tell the tilt."""
        return self.is_surface and self.is_well_supported and self.plane.coverage >= MIN_COVERAGE

    @property
    def can_level(self) -> bool:
        """Whether it is enough ground to level the scan by, and z not too far from its normal."""
        return self.tells_tilt and self.up[2] >= math.cos(MAX_TILT)


def is_ceiling(plane: GroundPlane, scan: Scan) -> bool:
    """Whether a plane is not below the sensor, nor most of the rest of the scan above it."""
    if plane.height >= MIN_CLEARANCE:
        return False
    height = plane.below(*scan.xyz[scan.grid.r < FARTHEST].T.astype(np.float64))
    more = np.count_nonzero(height > CLEAR) - np.count_nonzero(height < -CLEAR)
    # An empty field is seen from about its height, upside down from far above it.
    is_field = plane.height > -2.0 * LOW and View(plane, UPRIGHT).is_surface
    return more < 0 or (more == 0 and not is_field)


def is_below_sensor(plane: GroundPlane, scan: Scan) -> bool:
    """Whether a plane is seen as from a sensor at the origin: steeply, or by a cone of rays."""
    if plane.height < LOW or not LEAST_DEPRESSION <= plane.depression < STEEP_DEPRESSION:
        return plane.depression >= LEAST_DEPRESSION
    # Of all returns: lowest points begin at some range, and on a crowned road are off the cone.
    x, y, z = scan.xyz[scan.grid.r < FARTHEST].T.astype(np.float64)
    sector = np.floor(np.arctan2(y, x) * (0.5 * N_SECTORS / math.pi)).astype(np.int64)
    # The cone is about z, or about the normal in a cloud that was turned.
    drop, steepest = (-z, plane.height - plane.below(x, y, z)), np.full((2, N_SECTORS), -np.inf)
    for most, angle in zip(steepest, np.arctan2(drop, np.hypot(x, y)), strict=True):
        np.maximum.at(most, sector, angle)
    low, high = np.quantile(steepest[:, np.isfinite(steepest[0])], (0.25, 0.75), axis=1)
    return bool((high - low < ONE_ANGLE * high).any())


def is_doubtful(below: View | None) -> bool:
    """Whether the plane below z is so poor, so steeply seen or so high that z may not be up."""
    if below is None or below.is_steep or not (below.is_well_supported or below.is_whole):
        return True
    # A cone of tops, seen by the highest beam alone, may look whole.
    least = LEAST_DEPRESSION if below.plane.support < MIN_SUPPORT else -math.inf
    return not least <= below.plane.depression <= SHEER or below.plane.height < -LOW


def clearest(below: View | None, others: Iterable[View | None]) -> View | None:
    """Return the one of `others` that clearly is the ground, if `below`, about z, is not."""
    # No ground is above the sensor: roofs of cars, of whose ground little is seen, are.
    told = (
        view for view in others if view and view.tells_tilt
        and view.evidence > CLEARLY * max(below.evidence if below else 0.0, LEAST_EVIDENCE)
        and -MIN_CLEARANCE <= view.plane.height <= view.plane.reach / FAR
        # Crests about a vehicle's axles are level upside down; roofs have returns on both sides.
        and (view.up[2] > -math.cos(MAX_TILT) or (view.plane.is_below_sensor
             and view.plane.undercut * view.plane.overhung < UNDERCUT))
    )  # fmt: skip
    return max(told, key=lambda view: view.evidence, default=below)


@np.errstate(invalid='ignore', over='ignore')
def objection_to_ground(scan: Scan, view: View | None) -> str:
    """Return why a scan that shows this plane, or none, has no ground, or ''."""
    if view is not None and view.turn is UPRIGHT and _shows_lower_ends(view, scan):
        return LOWER_ENDS
    if (view and view.is_surface) or not np.isfinite(r := scan.grid.r).any():
        return ''
    nearest, middle, farthest = np.quantile(r[np.isfinite(r)], (0.01, 0.5, 0.99)).tolist()
    if farthest < TINY or (middle > HUGE and farthest > UNEQUAL * nearest):
        return f'half of the returns are within {middle:.3g} m: the cloud is not in metres'
    if nearest > FAR_OFF:
        return (
            f'the nearest returns are {nearest:.0f} m away: the origin of the cloud is not the '
            'sensor; give its place (sensor.origin_x, ..., the VIEWPOINT of a PCD file)'
        )
    return ''


def _shows_lower_ends(view: View, scan: Scan) -> bool:
    """Whether a plane is one of lower ends: of things cut away below it, or of walls."""
    plane, c = view.plane, scan.candidates
    can_be_cut = -plane.height - c.z.min() <= EDGE
    # A slope that is seen in few directions scatters as lower ends do.
    is_slope = plane.normal[2] < math.cos(CUT_TILT) or plane.coverage < MIN_COVERAGE
    if is_slope or (view.is_surface and not can_be_cut):
        return False
    height = plane.below(c.x, c.y, c.z)
    is_on = np.abs(height) < np.where(c.r < CUT_REACH, tolerance_at(c.r), 0.0)
    extent = scan.extent[c.segment[is_on] * scan.grid.n_bins + c.bin[is_on]]
    n, n_flat = map(np.count_nonzero, (extent, (extent > 0.0) & (extent <= LAYERS[2])))
    is_floor = view.is_surface or np.ptp(np.quantile(height[is_on], (0.25, 0.75))) <= FLOOR_SCATTER
    is_cut = n_flat < MOST_FLAT * n and can_be_cut and _is_cut(scan)
    return bool(is_cut or (not is_floor and n_flat < FEW_FLAT * n))


def _is_cut(scan: Scan) -> bool:
    """Whether returns are as many at all heights over the lowest candidate."""
    c, z = scan.candidates, scan.xyz[scan.grid.inside, 2]
    low, sector = c.z.min(), c.segment * N_SECTORS // c.n_segments
    first, *layers = (np.count_nonzero(z < low + layer) for layer in LAYERS)
    shares = first / layers[1], layers[0] / layers[1], layers[1] / layers[2]
    is_edge = shares[0] >= LOWEST_SHARE and min(shares[1:]) >= LEAST_SHARE
    n_around, n_all = (len(np.unique(part)) for part in (sector[c.z < low + LAYERS[2]], sector))
    return bool(is_edge and n_around >= ALL_AROUND * n_all and max(shares) <= MOST_SHARE)


def refusal(view: View, given: FloatArray) -> str:
    """One line on where the ground is; `given` is the rotation (3, 3) by the parameters."""
    up = given.T @ view.up
    roll, pitch = (round(angle, 3) + 0.0 for angle in angles_of(up))
    largest = int(np.argmax(np.abs(up)))
    axis = f'{"-" if up[largest] < 0.0 else ""}{"xyz"[largest]}'
    tilt = math.degrees(math.acos(np.clip(up[2], -1.0, 1.0)))
    problem = f'z is tilted by {tilt:.0f} degrees' if axis == 'z' else 'z does not point up'
    return (
        f'{problem}: the ground seems to be {view.plane.height * view.plane.normal[2]:.2f} m away '
        f'with {axis} nearest to up; turn the cloud, or set sensor.roll to {roll:.3f} and '
        f'sensor.pitch to {pitch:.3f} [rad]'
    )
