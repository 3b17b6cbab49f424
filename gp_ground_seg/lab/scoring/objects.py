"""Objects lost: what stands on the ground and is called ground, by class.

An object is lost where more than half of its returns from `MIN_HEIGHT` above the local ground are
called ground. What lies below does not count: there the feet of an object and the ground mix.

Two more measures are of what a robot meets: **low things**, labelled objects of which the upper
part is cut off, and **false cells**, ground that a costmap takes for an obstacle.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import KDTree

from gp_ground_seg.core.frame import BoolArray, FloatArray, Label, PointArray
from gp_ground_seg.data.semantic_kitti import VEGETATION, Entries
from gp_ground_seg.lab.scoring.metrics import Labels

MIN_HEIGHT = 0.3  # height above the local ground from which on a return on an object counts [m]
MIN_RETURNS = 10  # such returns that an object needs to be counted: of fewer, half is chance

CELL_SIZE = 0.5  # of the cells of ground that is known [m]
N_CELLS = 5  # of them that make the local ground
MAX_GROUND_DISTANCE = 5.0  # to the farthest of them [m]

LOW_HEIGHTS = (0.2, 0.3, 0.4, 0.5, 0.6)
"""Heights of low objects [m], each a class of its own, which only simulated scans have."""
LOW_CLASSES = tuple(f'low, {height:g} m' for height in LOW_HEIGHTS)
PLANTS = 'vegetation'  # class of what is no object of its own: it is neither cut nor lost
CLASSES: dict[str, tuple[int, ...]] = {
    'vehicle': (10, 13, 16, 18, 20, 252, 256, 257, 258, 259),
    'person': (30, 254),
    'cyclist': (11, 15, 31, 32, 253, 255),
    PLANTS: (VEGETATION,),
    **dict.fromkeys(LOW_CLASSES, ()),
}
"""Classes of objects, by numbers of SemanticKITTI; two-wheelers with or without a rider."""
LOW_MIN_HEIGHT, LOW_MIN_RETURNS = 0.1, 3  # `MIN_HEIGHT` [m] and `MIN_RETURNS` of `LOW_CLASSES`

CELLS = {'road_cells': (40, 44), 'ground_cells': (40, 44, 48, 49, 60)}
"""Classes of SemanticKITTI whose cells are counted."""
SHARES = {
    'low_things': 'returns on low objects called ground',
    'road_cells': 'cells of road called obstacle',
    'ground_cells': 'cells of ground called obstacle',
}
"""Shares that are counted, in words; of each the sums are ``NAME_n`` and ``NAME_wrong``."""
CUT_HEIGHT = 0.45  # height above the ground at which labelled objects are cut [m]
LOW_OVER, LOW_RANGE, LOW_N_GROUND = 0.15, 25.0, 5
"""A return on a cut object counts if it is more than so high above the ground [m], and nearer
than this [m]; number of the nearest returns of ground whose median is that ground."""
FALSE_SIZE, FALSE_RANGE, FALSE_OVER = 0.1, 20.0, 0.15
"""Size of the cells of ground [m], range within which they count [m], and height over the surface
[m] from which on an obstacle in them makes them false."""


class Objects(NamedTuple):
    """Which of the N returns of a scan lie on objects."""

    class_of: npt.NDArray[np.integer]  # (N,) index into `CLASSES`; negative: on no object
    object_id: npt.NDArray[np.integer]  # (N,) number of it within its class; 0 = not known
    ground_z: PointArray  # (N,) local ground [m]; NaN = not known: does not count


OBJECT_COUNTS = ('n_returns', 'n_ground', 'n_objects', 'n_lost')
"""Returns from `MIN_HEIGHT` above the ground, and those called ground; objects with at least
`MIN_RETURNS` of them, and those with more than half of them called ground."""


def count_objects(points: PointArray, label: Labels, objects: Objects) -> list[dict[str, Any]]:
    """Count returns on objects and objects called ground, in a row for each class.

    `points` (N, >=3) are x, y, z [m], `label` (N,) what a method says of them; UNKNOWN is not
    ground. Classes without a return that counts are left out.
    """
    xyz = points[:, :3].astype(np.float64)
    on = (objects.class_of >= 0) & np.isfinite(xyz).all(axis=1)
    least = np.where(_is_low(objects.class_of), LOW_MIN_HEIGHT, MIN_HEIGHT)
    counts = on & (xyz[:, 2] - objects.ground_z >= least)
    kind, is_ground = objects.class_of[counts], label[counts] == Label.GROUND
    known = (object_id := objects.object_id[counts]) != 0
    pairs = np.column_stack([kind, object_id])[known]
    of_object, number, n_returns = np.unique(
        pairs, axis=0, return_inverse=True, return_counts=True
    )
    n_ground = np.bincount(number.reshape(-1), is_ground[known], minlength=len(n_returns))
    kinds = of_object[:, 0]
    enough = n_returns >= np.where(_is_low(kinds), LOW_MIN_RETURNS, MIN_RETURNS)
    counted = kind, kind[is_ground], kinds[enough], kinds[enough & (2 * n_ground > n_returns)]
    table = np.column_stack([np.bincount(part, minlength=len(CLASSES)) for part in counted])
    return [
        {'class': name, **dict(zip(OBJECT_COUNTS, numbers, strict=True))}
        for name, numbers in zip(CLASSES, table.tolist(), strict=True)
        if numbers[0]
    ]


def _is_low(class_of: npt.NDArray[np.integer]) -> BoolArray:
    """Whether objects are of `LOW_CLASSES`, the last of all."""
    return class_of >= len(CLASSES) - len(LOW_CLASSES)


def local_ground(points: PointArray, is_ground: BoolArray, wanted: BoolArray) -> FloatArray:
    """Height of the ground about points (N, >=3), by those that are ground (N,) [m].

    The ground is reduced to the median height of its returns in cells of `CELL_SIZE`; about a
    point it is the median of the `N_CELLS` nearest of these. NaN where the farthest of them is
    more than `MAX_GROUND_DISTANCE` away, and where it is not `wanted` (N,).
    """
    xyz = points[:, :3].astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    ground, wanted = xyz[finite & is_ground], finite & wanted
    result = np.full(len(xyz), np.nan)
    if not wanted.any():
        return result
    # One complex number for each cell, which sorts much faster than a pair.
    cell = np.floor(ground[:, 0] / CELL_SIZE) + 1j * np.floor(ground[:, 1] / CELL_SIZE)
    places, number = np.unique(cell, return_inverse=True)
    if len(places) < N_CELLS:
        return result
    height = np.asarray(ndimage.median(ground[:, 2], number, range(len(places))))
    tree = KDTree((np.column_stack([places.real, places.imag]) + 0.5) * CELL_SIZE)
    distance, nearest = tree.query(xyz[wanted, :2], k=N_CELLS)
    median = np.median(height[nearest], axis=1)
    result[wanted] = np.where(distance[:, -1] <= MAX_GROUND_DISTANCE, median, np.nan)
    return result


def labelled_objects(points: PointArray, entries: Entries, is_ground: BoolArray) -> Objects:
    """Objects by the entries of a ``.label`` file (N,), and the local ground by what is ground.

    Instances are numbered by class, so that the whole entry is the number of an object.
    """
    class_of = np.full(len(entries), -1)
    for k, numbers in enumerate(CLASSES.values()):
        class_of[np.isin(entries & 0xFFFF, numbers)] = k
    object_id = np.where(entries >> 16 > 0, entries, 0).astype(np.int64)
    return Objects(class_of, object_id, local_ground(points, is_ground, class_of >= 0))


class CutScan(NamedTuple):
    """A scan of N points without what is high of its objects."""

    is_kept: BoolArray  # (N,) whether a return is left
    is_low: BoolArray  # (N,) whether it counts as one on a low thing

    def count_ground(self, label: Labels) -> dict[str, int]:
        """Count low returns called ground; `label` is of those left, in their order."""
        is_low = self.is_low[self.is_kept]
        n_wrong = int((label[is_low] == Label.GROUND).sum())
        return {'low_things_n': int(is_low.sum()), 'low_things_wrong': n_wrong}


def cut_objects(
    points: PointArray, is_object: BoolArray, is_ground: BoolArray, height: float
) -> CutScan:
    """Cut objects at a `height` above the ground [m]; what is left is as low as a parcel.

    `points` (N, >=3) are x, y, z [m], `is_object` and `is_ground` (N,) what the labels say. Rays
    that met the upper part have no return.
    """
    xyz = points[:, :3].astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    ground, on = xyz[finite & is_ground], finite & is_object
    over = np.full(len(xyz), np.nan)
    if len(ground) >= LOW_N_GROUND and on.any():
        _, nearest = KDTree(ground[:, :2]).query(xyz[on, :2], k=LOW_N_GROUND)
        over[on] = xyz[on, 2] - np.median(ground[nearest, 2], axis=1)
    is_near = np.hypot(xyz[:, 0], xyz[:, 1]) < LOW_RANGE
    is_kept = ~(over > height)
    return CutScan(is_kept, is_kept & (over > LOW_OVER) & is_near)


def count_false_cells(
    points: PointArray, label: Labels, height: PointArray, semantic: npt.NDArray[np.integer]
) -> dict[str, int]:
    """Count cells of labelled ground, and those that a costmap takes for an obstacle.

    A cell is false where one of its returns of ground (`semantic`, (N,)) is called obstacle
    (`label`, (N,)) and is `FALSE_OVER` or more above the surface: `height` (N,) [m]. `points`
    (N, >=2) are x, y [m].
    """
    near = np.hypot(points[:, 0], points[:, 1]) < FALSE_RANGE
    x, y = np.floor(points[near, :2] / FALSE_SIZE).T
    cell = x + 1j * y
    is_false = (label[near] == Label.OBSTACLE) & (height[near] >= FALSE_OVER)
    found = dict[str, int]()
    for name, numbers in CELLS.items():
        own = np.isin(semantic[near], numbers)
        n_cells, n_false = (len(np.unique(cell[part])) for part in (own, own & is_false))
        found |= {f'{name}_n': n_cells, f'{name}_wrong': n_false}
    return found
