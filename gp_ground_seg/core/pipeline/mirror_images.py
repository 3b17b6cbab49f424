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
from gp_ground_seg.core.pipeline.ground_plane import GroundPlane
from gp_ground_seg.core.pipeline.ground_view import View
from gp_ground_seg.core.pipeline.lowest_points import tolerance_at
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
MIRRORED = 0.4
"""Share of what is deep below a plane that has a counterpart over it, from which the plane is a
mirror. Simulated wet scans have 0.45 to 0.88, dry real ones outdoors none: the tiles tell them."""


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
    grid, plane_z = scan.grid, -pose.sensor_height
    if not pose.starts_rays or plane_z >= 0.0 or (view is not None and view.is_dry):
        return NO_IMAGES
    is_mirror = view is not None and view.is_mirror and pose.height_estimated
    if not is_mirror and mirror_share(GroundPlane(pose.sensor_height), scan) < MIRRORED:
        return NO_IMAGES
    inside = np.flatnonzero(grid.inside)
    r, z = grid.r[inside].astype(np.float64), scan.xyz[inside, 2].astype(np.float64)
    slope, cell = slope_of_sight(r, z), grid.cell[inside].astype(np.int64)
    is_ground = (r >= NEAREST) & (r < GROUND_REACH) & (np.abs(z - plane_z) <= tolerance_at(r))
    shape = grid.n_segments, grid.n_bins
    nearer = _nearer_about(slope[is_ground], cell[is_ground], shape, N_ASIDE)[cell]
    # Only a line of sight that points down meets the plane: at its height over its slope.
    can_be = (nearer < 0.0) & ((slope - nearer) * plane_z > OVER_SIGHT * nearer)
    can_be &= (r >= NEAREST) & (r < IMAGE_REACH) & (z < plane_z + DEEP)
    low = np.flatnonzero(can_be)
    bare = np.flatnonzero(is_ground & (slope >= nearer))
    extremes = scan.tiles.extremes[scan.tiles.tile[inside[bare]]]
    bare = bare[extremes[:, 1] - extremes[:, 0] < 2.0 * DEEP]  # where nothing stands
    is_image = np.zeros(len(z), dtype=np.bool_)
    for _ in range(2):  # the second time without images that count as ground the first time
        tells = bare[~is_image[bare]]
        before = _ground_before(z[tells], cell[tells], shape)[cell[low]]
        is_seen = np.isfinite(before)
        mirror_z = np.where(is_seen, before, plane_z)
        is_image[low] = is_deep = z[low] < mirror_z - np.where(is_seen, BELOW, DEEP)
    rise = 2.0 * (mirror_z - z[low])
    return MirrorImages(inside[low[is_deep]], rise[is_deep])


@np.errstate(invalid='ignore', over='ignore')
def mirror_share(plane: GroundPlane, scan: Scan) -> float:
    """Share of what is deep below a plane that is the image of another return; 0 if little is.

    A wet road mirrors what stands on it: raised over the road again, its image meets other returns
    of it. What is seen of a valley, or below a table or a dock, meets none.
    """
    candidates = scan.candidates
    over = plane.below(candidates.x, candidates.y, candidates.z)
    near = (candidates.r >= NEAREST) & (candidates.r < WET_REACH)
    deep = np.flatnonzero(near & (over < -DEEP) & (over > -DEEPEST))
    is_on_it = near & (np.abs(over) <= tolerance_at(candidates.r))
    if len(deep) <= WET_SHARE * np.count_nonzero(is_on_it):
        return 0.0
    place = np.column_stack([candidates.x[deep], candidates.y[deep], candidates.z[deep]])
    normal, tile = plane.normal, candidates.tile[deep]
    raised = place - (2.0 * over[deep] * normal[2])[:, None] * normal
    # A valley has little above it that is as high: no need to look closer.
    if np.mean(scan.tiles.extremes[tile, 1] > raised[:, 2] - COUNTERPART) < MIRRORED:
        return 0.0
    # Boxes with a return, and a margin of one on all sides.
    low = raised.min(axis=0) - 2.0 * COUNTERPART
    shape = ((raised.max(axis=0) - low) / COUNTERPART).astype(np.int64) + 3
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    inside, index = plane.below(*scan.xyz.T) > DEEP, np.zeros(len(scan.xyz), dtype=np.int64)
    for column, least, n, stride in zip(scan.xyz.T, low.tolist(), shape, strides, strict=True):
        box = (column - least) / COUNTERPART
        inside &= (box > 0.0) & (box < n)
        index += box.astype(np.int64) * stride
    has_return = np.zeros(math.prod(shape.tolist()), dtype=np.bool_)
    has_return[index[inside]] = True
    around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3) @ strides
    boxes = ((raised - low) / COUNTERPART).astype(np.int64) @ strides
    return float(has_return[np.add.outer(boxes, around)].any(axis=1).mean())


def in_sight(candidates: Candidates) -> Candidates:
    """Candidates below the sensor to which no ray passes below a nearer one beside it.

    Mirror images may be the lowest returns of most cells: a plane through these is that of a
    ceiling, or of nothing.
    """
    slope = slope_of_sight(candidates.r, candidates.z)
    shape = candidates.n_segments, int(candidates.bin.max(initial=0)) + 1
    cell = candidates.segment * shape[1] + candidates.bin
    tells = np.flatnonzero((candidates.r >= NEAREST) & (slope < 0.0))
    nearer = _nearer_about(slope[tells], cell[tells], shape, 1)[cell]
    return candidates.where((slope < 0.0) & (slope >= nearer))


def slope_of_sight(r: FloatArray, z: FloatArray) -> FloatArray:
    """Slope of the line of sight to returns at a range and a height [m]."""
    return np.asarray(z / np.maximum(r, NEAREST))


def _nearer_about(
    slope: FloatArray, cell: IntArray, shape: tuple[int, int], n_aside: int
) -> FloatArray:
    """Highest slope to ground in a nearer bin, there or in `n_aside` segments on either side.

    `slope` and `cell`, (G,), are those of the ground, `shape` the numbers of segments and bins.
    Returns that of each cell; -inf where there is no such ground.
    """
    own: FloatArray = np.full(shape, -np.inf)
    np.maximum.at(own.reshape(-1), cell, slope)
    highest = own
    for aside in range(1, n_aside + 1):
        both = np.maximum(np.roll(own, aside, axis=0), np.roll(own, -aside, axis=0))
        highest = np.maximum(highest, both)
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
