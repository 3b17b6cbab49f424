"""Stage 2: mirror images of things on a wet road, or in a polished floor.

A ray that the road reflects is taken to have gone straight on: its return lies as far below the
road as what it met stands above, at the same place in plan. Such a ray seems to pass below ground
that is seen nearer, which no ray can, while over the edge of a ditch, a dock or stairs rays pass
above it. Images that are raised again to what they are images of are no ground.

Where images are the lowest returns of most cells, the plane of the ground is looked for past them.
"""

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import Candidates, FloatArray, IntArray, PointArray, Scan
from gp_ground_seg.core.pipeline.ground_plane import GroundPlane, crossing_of
from gp_ground_seg.core.pipeline.ground_view import View
from gp_ground_seg.core.pipeline.lowest_points import tolerance_at
from gp_ground_seg.core.pipeline.points import rotation
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose

DEEP, DEEPEST = 0.15, 10.0
"""Depths below the plane at which a return may be an image [m]: more than that of a kerb."""
BELOW = 0.08
"""Depth below the ground before it, from which a return below the line of sight to ground is an
image on a wet road [m]: noise is less. At the foot of a wall images are no deeper."""
OVER_SIGHT = 0.05
"""Height up to which a ray to an image passes over ground that is seen nearer [m]: noise. Of rays
that meet the road side by side some come back from it, others from what they are mirrored to."""
NEAREST, GROUND_REACH, IMAGE_REACH = 1.0, 40.0, 60.0
"""Range from which returns may be images, up to which ground tells them, and up to which they may
be [m]: nearer there may be the robot itself."""
N_ASIDE = 4
"""Segments on each side whose ground tells the images of a segment."""
WET_SHARE, WET_REACH = 0.1, 20.0
"""Candidates deep below the plane for each on it, both up to this range [m], from which they are
asked for what they are images of."""
COUNTERPART = 0.2
"""Side of the boxes in which a counterpart is looked for: its own and those around it [m]."""
MIRRORED, TILTED = 0.28, 1.3
"""Share of what is deep below a plane that has a counterpart over it, and a ray through what is
seen of the plane, from which it is a mirror. Simulated wet scans have 0.3 to 0.8, sparse ones 0.23
to 0.38, tables up to 0.26, crowded rooms and dry land up to 0.11. And that of a tilted one over
that of a level one from which it is the mirror: 1.38 and more at 2 degrees, 1.24 by images."""


class MirrorImages(NamedTuple):
    """Which returns are mirror images, and how high what they are images of is over them."""

    points: IntArray  # (I,) indices
    rise: FloatArray  # (I,) [m]

    def raised(self, xyz: PointArray) -> PointArray:
        """Points (N, 3), each image where what it is an image of is."""
        result: PointArray = xyz.copy('K')
        result[self.points, 2] += self.rise.astype(result.dtype)
        return result

    def left_out(self, scan: Scan) -> Scan:
        """Scan of the points `raised` without candidates that are images."""
        x, y = scan.xyz[self.points, :2].T
        candidates = scan.candidates
        # A candidate has the place of its return; both coordinates as one number.
        is_image = np.isin(candidates.x + 1j * candidates.y, x + 1j * y)
        return scan._replace(candidates=candidates.where(~is_image))


NO_IMAGES = MirrorImages(np.zeros(0, dtype=np.int64), np.zeros(0))


def find_mirror_images(scan: Scan, pose: SensorPose, view: View | None) -> MirrorImages:
    """Find the mirror images of a scan in the level frame: none unless the road is wet.

    An image is below the ground before it, as deep as what it is an image of is high, and hardly
    above the line of sight to ground that is seen nearer. Where rays start must be known, or
    nothing is told. `view` is the plane that the pose was estimated from, if there is one.
    """
    grid, height, seen = scan.grid, pose.sensor_height, pose.measured
    if seen is None or not pose.starts_rays or height <= 0.0 or (view is not None and view.is_dry):
        return NO_IMAGES
    # The mirror is level, or tilted as far as the sensor was left so.
    x, y, z = pose.rotation @ rotation(seen.roll, seen.pitch)[2]
    level, tilted = GroundPlane(height), GroundPlane(height, -x / z, -y / z)
    share, tilted_share = mirror_share(level, scan), mirror_share(tilted, scan)
    if max(share, tilted_share) < MIRRORED:
        return NO_IMAGES
    plane = tilted if tilted_share > TILTED * share else level
    inside = np.flatnonzero(grid.inside)
    r, z = grid.r[inside].astype(np.float64), plane.below(*scan.xyz[inside].T.astype(np.float64))
    slope, cell = (z - height) / np.maximum(r, NEAREST), grid.cell[inside].astype(np.int64)
    is_ground = (r >= NEAREST) & (r < GROUND_REACH) & (np.abs(z) <= tolerance_at(r))
    shape = grid.n_segments, grid.n_bins
    nearer = _nearer_about(slope[is_ground], cell[is_ground], shape, N_ASIDE)[cell]
    # Only a line of sight that points down meets the plane: at its height over its slope.
    can_be = (nearer < 0.0) & ((nearer - slope) * height > OVER_SIGHT * nearer)
    can_be &= (r >= NEAREST) & (r < IMAGE_REACH) & (z < DEEP)
    low = np.flatnonzero(can_be)
    bare = np.flatnonzero(is_ground & (slope >= nearer))
    extremes = scan.tiles.extremes[scan.tiles.tile[inside[bare]]]
    bare = bare[extremes[:, 1] - extremes[:, 0] < 2.0 * DEEP]  # where nothing stands
    is_image = np.zeros(len(z), dtype=np.bool_)
    for _ in range(2):  # the second time without images that count as ground the first time
        tells = bare[~is_image[bare]]
        before = _ground_before(z[tells], cell[tells], shape)[cell[low]]
        is_seen = np.isfinite(before)
        mirror_z = np.where(is_seen, before, 0.0)
        is_image[low] = is_deep = z[low] < mirror_z - np.where(is_seen, BELOW, DEEP)
    return MirrorImages(inside[low[is_deep]], 2.0 * (mirror_z - z[low])[is_deep])


@np.errstate(invalid='ignore', over='ignore')
def mirror_share(plane: GroundPlane, scan: Scan) -> float:
    """Share of what is deep below a plane that is the image of another return; 0 if little is.

    A wet road mirrors what stands on it: raised over the road again, its image meets other returns
    of it, and the ray to it crosses the road where it is seen. What is seen of a valley meets
    none; rays to the floor between tables, or of a crowded room, cross a plane beside its returns.
    """
    c, grid = scan.candidates, scan.grid
    over = plane.below(c.x, c.y, c.z)
    near = (c.r >= NEAREST) & (c.r < WET_REACH)
    deep = np.flatnonzero(near & (over < -DEEP) & (over > -DEEPEST))
    is_on_it = np.abs(over) <= tolerance_at(c.r)
    if len(deep) <= WET_SHARE * np.count_nonzero(near & is_on_it):
        return 0.0
    place = np.column_stack([c.x[deep], c.y[deep], c.z[deep]])
    raised = place - (2.0 * over[deep] * plane.normal[2])[:, None] * plane.normal
    # A valley has little above it that is as high: no need to look closer.
    is_below = scan.tiles.extremes[c.tile[deep], 1] > raised[:, 2] - COUNTERPART
    if is_below.mean() < MIRRORED:
        return 0.0
    # The plane is seen in the bin that the ray crosses, or the one before or behind.
    cell, crossing = c.segment * grid.n_bins + c.bin, crossing_of(c.r[deep], over[deep], plane[:3])
    crossed = cell[deep] - c.bin[deep] + np.searchsorted(grid.edges[1:], crossing, side='right')
    is_crossed = np.isin(crossed + np.array([[-1], [0], [1]]), cell[is_on_it]).any(axis=0)
    if is_crossed.mean() < MIRRORED:
        return 0.0
    # Boxes with a return, and a margin of one on all sides.
    low, high = raised.min(axis=0) - 2.0 * COUNTERPART, raised.max(axis=0) + 2.0 * COUNTERPART
    about = np.flatnonzero(plane.below(*scan.xyz.T) > DEEP)
    for values, first, last in zip(scan.xyz.T, low, high, strict=True):
        about = about[(values[about] > first) & (values[about] < last)]
    box = (scan.xyz.T.take(about, axis=1) - low[:, None]) / COUNTERPART
    has_return = np.zeros(((high - low) / COUNTERPART).astype(np.int64) + 1, dtype=np.bool_)
    has_return[tuple(box.astype(np.int64))] = True
    around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 1, 3)
    boxes = ((raised - low) / COUNTERPART).astype(np.int64) + around
    return float(np.mean(is_crossed & has_return[tuple(boxes.T)].any(axis=1)))


def in_sight(candidates: Candidates) -> Candidates:
    """Candidates below the sensor to which no ray passes below a nearer one beside it.

    Mirror images may be the lowest returns of most cells: a plane through these is that of a
    ceiling, or of nothing.
    """
    slope = candidates.z / np.maximum(candidates.r, NEAREST)
    shape = candidates.n_segments, int(candidates.bin.max(initial=0)) + 1
    cell = candidates.segment * shape[1] + candidates.bin
    tells = np.flatnonzero((candidates.r >= NEAREST) & (slope < 0.0))
    nearer = _nearer_about(slope[tells], cell[tells], shape, 1)[cell]
    return candidates.where((slope < 0.0) & (slope >= nearer))


def _nearer_about(
    slope: FloatArray, cell: IntArray, shape: tuple[int, int], n_aside: int
) -> FloatArray:
    """Highest slope to ground in a nearer bin, there or in `n_aside` segments on either side.

    `slope` and `cell`, (G,), are those of the ground, `shape` the numbers of segments and bins.
    Returns that of each cell; -inf where there is no such ground.
    """
    own: FloatArray = np.full(shape, -np.inf)
    np.maximum.at(own.reshape(-1), cell, slope)
    asides = range(-n_aside, n_aside + 1)
    highest = np.max([np.roll(own, aside, axis=0) for aside in asides], axis=0)
    before: FloatArray = np.full(shape, -np.inf)
    np.maximum.accumulate(highest[:, :-1], axis=1, out=before[:, 1:])
    return before.reshape(-1)


def _ground_before(z: FloatArray, cell: IntArray, shape: tuple[int, int]) -> FloatArray:
    """Mean height of the ground in the last bin before each cell that has some [m], or NaN.

    `z` and `cell`, (G,), are those of the ground.
    """
    number, total = (np.bincount(cell, w, math.prod(shape)).reshape(shape) for w in (None, z))
    last = np.maximum.accumulate(np.where(number > 0, np.arange(shape[1]), 0), axis=1)
    before: FloatArray = np.full(shape, np.nan)
    with np.errstate(invalid='ignore'):
        before[:, 1:] = np.take_along_axis(total / number, last[:, :-1], axis=1)
    return before.reshape(-1)
