"""Stage 2: what a plane of a scan tells: the height, the tilt, or that z is not up."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray, Scan, as_index
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
GOOD_SUPPORT, TALL = 0.9, 6.0
"""Support below which a plane this far below z may well be a facade [m]."""
OTHER_MIN_SUPPORT, OTHER_MIN_REACH = 0.5, 10.0
"""Support of a plane about another axis, and range that it reaches [m]: walls and ceilings of
rooms seldom do."""
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
seen from a sensor upside down, there is less than below it, and a scan of one beam has neither."""

COLUMN = 0.2, 0.6
"""Heights over the plane between which a column is looked for over what lies on it [m]."""
COLUMNS, COLUMNS_REACH = 0.55, 20.0
"""Share of the candidates on a plane, up to this range [m], with a column over them, from which
they are lower ends, unless there is a floor: of whole scans outdoors the most was 0.37, of cut
ones mostly 0.6 to 1."""
BEFORE = 0.1
"""Distance from which a return before a column is of the floor before it [m]."""
FLOOR_SCATTER, ROUGH_FLOOR = 0.025, 0.18
"""Distance of the quartiles of the heights of all candidates on the plane, or of those without a
column, up to which they lie on a floor [m]: 0.003 to 0.02 in crowded rooms and corridors, 0.03 to
0.15 where the ground was cut away; and how much more it may be where all are without a column:
rough paths between hedges have 0.05 where a third are."""
CUT_TILT = 0.08
"""Tilt [rad] from which a plane is not that at which ground was cut away."""
FLOOR_SHARE = 0.1
"""Least share of the candidates without a column that may show a floor by themselves."""
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
    def is_dry(self) -> bool:
        """Whether it is known to have no mirror images, and to be none of a polished ceiling."""
        is_no_image = self.plane.overhung < OVERHUNG and self.plane.support >= MIN_SUPPORT
        return self.is_mirror is False and is_no_image

    @property
    def is_surface(self) -> bool:
        """Whether it is ground for sure: seen at several angles, or several rows deep."""
        plane = self.plane
        is_wide = plane.support >= MIN_SUPPORT and plane.coverage >= MIN_COVERAGE
        is_spread = plane.height >= MIN_CLEARANCE and plane.spread >= MIN_SPREAD
        depth = plane.n_support / (plane.coverage * N_SECTORS)
        return is_spread or (is_wide and depth >= MIN_DEPTH)

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
    return bool(np.count_nonzero(height > CLEAR) <= np.count_nonzero(height < -CLEAR))


def is_below_sensor(plane: GroundPlane, scan: Scan) -> bool:
    """Whether a plane is seen as from a sensor at the origin: steeply, or by a cone of rays."""
    if plane.height < LOW or not LEAST_DEPRESSION <= plane.depression < STEEP_DEPRESSION:
        return plane.depression >= LEAST_DEPRESSION
    c, steepest = scan.candidates, np.full(N_SECTORS, -np.inf)
    np.maximum.at(steepest, c.segment * N_SECTORS // c.n_segments, np.arctan2(-c.z, c.r))
    low, high = np.quantile(steepest[np.isfinite(steepest)], (0.25, 0.75))
    return bool(high - low < ONE_ANGLE * high)


def is_doubtful(below: View | None) -> bool:
    """Whether the plane below z is so poor, or so far away, that z may not be up."""
    if below is None or below.is_steep or not (below.is_well_supported or below.is_whole):
        return True
    return below.plane.height > TALL and below.plane.support < GOOD_SUPPORT


def clearest(below: View | None, others: Iterable[View | None]) -> View | None:
    """Return the one of `others` that clearly is the ground, if `below`, about z, is not."""
    found = [
        view
        for view in others
        if view is not None
        and view.tells_tilt
        # No ground is above the sensor: roofs of cars, of whose ground little is seen, are.
        and -MIN_CLEARANCE <= view.plane.height <= TALL
        and view.plane.support >= OTHER_MIN_SUPPORT
        and view.plane.reach >= OTHER_MIN_REACH
    ]
    return max(found, key=lambda view: view.plane.support, default=below)


@np.errstate(invalid='ignore', over='ignore')
def objection_to_ground(scan: Scan, view: View | None) -> str:
    """Return why a scan that shows this plane, or none, has no ground, or ''."""
    if view is not None and view.turn is UPRIGHT and _shows_lower_ends(view.plane, scan):
        return LOWER_ENDS
    r = scan.grid.r if view is None or not view.is_surface else scan.grid.r[:0]
    r = r[np.isfinite(r)]
    if len(r) == 0:
        return ''
    nearest, middle, farthest = np.quantile(r, (0.01, 0.5, 0.99)).tolist()
    if farthest < TINY or (middle > HUGE and farthest > UNEQUAL * nearest):
        return f'half of the returns are within {middle:.3g} m: the cloud is not in metres'
    if nearest > FAR_OFF:
        return (
            f'the nearest returns are {nearest:.0f} m away: the origin of the cloud is not the '
            'sensor; give its place (sensor.origin_x, ..., the VIEWPOINT of a PCD file)'
        )
    return ''


def _shows_lower_ends(plane: GroundPlane, scan: Scan) -> bool:
    """Whether most of what lies on a plane is lower ends of columns, and the rest is no floor."""
    if plane.normal[2] < math.cos(CUT_TILT):
        return False
    candidates, tiles = scan.candidates, scan.tiles
    height = plane.below(candidates.x, candidates.y, candidates.z)
    tolerance = np.where(candidates.r < COLUMNS_REACH, tolerance_at(candidates.r), 0.0)
    is_near, (low, high) = np.abs(height) < tolerance, COLUMN
    height, tile, r = height[is_near], as_index(candidates.tile[is_near]), candidates.r[is_near]
    enough = COLUMNS * len(tile)
    if np.count_nonzero((tiles.extremes[:, 1] - tiles.extremes[:, 0])[tile] > low) <= enough:
        return False
    over = plane.below(*scan.xyz.T)
    in_column = (over > low) & (over < high) & (tiles.tile >= 0)
    column_r = np.full(len(tiles.extremes), np.inf)
    np.minimum.at(column_r, tiles.tile[in_column], scan.grid.r[in_column])
    # Floor before a column is nearer than what stands on it.
    alone = height[r < column_r[tile] - BEFORE]
    if len(tile) - len(alone) <= enough:
        return False
    floors = [z for z in (height, alone) if len(z) > FLOOR_SHARE * len(tile)]
    scatter = [np.subtract(*np.quantile(z, (0.75, 0.25))) for z in floors]
    floor_scatter = max(FLOOR_SCATTER, ROUGH_FLOOR * len(alone) / len(tile))
    return bool(min(scatter, default=np.inf) > floor_scatter)


def refusal(view: View, given: FloatArray) -> str:
    """One line on where the ground is; `given` is the rotation (3, 3) by the parameters."""
    up = given.T @ view.up
    roll, pitch = (round(angle, 3) + 0.0 for angle in angles_of(up))
    largest = int(np.argmax(np.abs(up)))
    axis = f'{"-" if up[largest] < 0.0 else ""}{"xyz"[largest]}'
    tilt = math.degrees(math.acos(np.clip(up[2], -1.0, 1.0)))
    problem = f'z is tilted by {tilt:.0f} degrees' if axis == 'z' else 'z does not point up'
    height = view.plane.height * view.plane.normal[2]
    return (
        f'{problem}: the ground seems to be {height:.2f} m away with {axis} nearest to up; turn '
        f'the cloud, or set sensor.roll to {roll:.3f} and sensor.pitch to {pitch:.3f} [rad]'
    )
