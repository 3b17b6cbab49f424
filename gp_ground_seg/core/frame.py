"""Values that pass from stage to stage of a frame: arrays with their shapes and units.

Named tuples, because compiled code reads their fields as numpy code does. Ragged arrays are
values and `offsets`: those of segment m are ``offsets[m]:offsets[m + 1]``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
CellArray = npt.NDArray[np.int32]
BoolArray = npt.NDArray[np.bool_]
PointArray = npt.NDArray[np.floating]
"""Coordinates, in single or double precision."""
Values = Any
"""Arguments and results of shared formulas: arrays in numpy code, numbers in compiled code."""

OUTSIDE = -1
"""Bin, cell and tile of a point that is beyond the grid."""
NOT_FINITE = -2
"""Cell of a point with NaN or infinity. `take_points` sets points without a return to NaN."""


def as_index(places: CellArray) -> IntArray:
    """Places in the type that numpy indexes by: with another it takes three times as long."""
    return places.astype(np.int64)


@contextmanager
def usual_errors() -> Iterator[None]:
    """Have numpy raise nothing within the block or function, whatever the caller has set.

    Small numbers become 0 in most frames. Other faults warn, unless the caller ignores them.
    """
    how: Any = {fault: 'ignore' if x == 'ignore' else 'warn' for fault, x in np.geterr().items()}
    with np.errstate(**{**how, 'under': 'ignore'}):
        yield


class Label(IntEnum):
    """Class of a point; the values are what ``Segmentation.label`` holds."""

    UNKNOWN = 0
    GROUND = 1
    OBSTACLE = 2


class PolarGrid(NamedTuple):
    """Where each point lies in the radial grid."""

    cell: CellArray  # (N,) cell ``segment * n_bins + bin``, or `OUTSIDE`, or `NOT_FINITE`
    # (N,) horizontal range [m], in the precision of the points; NaN for points that are not finite
    r: PointArray
    edges: FloatArray  # (n_bins + 1,) range of the bin edges [m], read-only
    n_segments: int  # number of segments M

    @property
    def n_bins(self) -> int:
        """Bins of each segment."""
        return len(self.edges) - 1

    @property
    def inside(self) -> BoolArray:
        """Which points lie in a cell, (N,) bool."""
        return self.cell >= 0

    @property
    def segment(self) -> IntArray:
        """Angular segment of each point, counter-clockwise from -x, (N,) int64; 0 outside."""
        return np.maximum(self.cell, 0).astype(np.int64) // self.n_bins

    @property
    def bin(self) -> IntArray:
        """Radial bin of each point, (N,) int64, or `OUTSIDE`."""
        return np.where(self.inside, self.cell.astype(np.int64) % self.n_bins, OUTSIDE)


class Tiles(NamedTuple):
    """Square tiles with a point, T of them, numbered in any order.

    Together with the empty ones they make a square that holds the polar grid.
    """

    tile: CellArray  # (N,) tile of each point, or `OUTSIDE`
    # (T, 2) height of the lowest and of the highest point of each tile [m], in the precision of
    # the points
    extremes: PointArray
    place: CellArray  # (T,) place in the square, ``column * n_sides + row``
    at: CellArray  # (n_sides^2,) tile at each place, or `OUTSIDE` where it is empty

    @property
    def n_sides(self) -> int:
        """Tiles along a side of the square."""
        return math.isqrt(len(self.at))

    def around(self) -> CellArray:
        """Tile at each place about each tile and its own, (T, 9); `OUTSIDE` where none is."""
        width = self.n_sides + 2
        padded = np.full((width, width), OUTSIDE, dtype=np.int32)
        padded[1:-1, 1:-1] = self.at.reshape(width - 2, width - 2)
        steps = (np.arange(3)[:, None] * width + np.arange(3)).ravel()
        place = as_index(self.place)
        return np.asarray(padded.ravel()[(place + 2 * (place // self.n_sides))[:, None] + steps])


class Candidates(NamedTuple):
    """Ground candidates PG_m of all segments, near to far in each."""

    r: FloatArray  #: (C,) horizontal range of the lowest point of each occupied bin [m]
    z: FloatArray  #: (C,) its height [m]
    bin: IntArray  #: (C,) bin of each candidate
    density: FloatArray  #: (C,) vertical density of each candidate's bin [points/m^2]
    offsets: IntArray  #: (M + 1,) candidates of segment m are ``offsets[m]:offsets[m + 1]``
    tile: CellArray  #: (C,) tile of each candidate
    x: FloatArray  #: (C,) place of each candidate [m]
    y: FloatArray  #: (C,) the same [m]

    @property
    def segment(self) -> IntArray:
        """Segment of each candidate, (C,) int64."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))

    @property
    def n_segments(self) -> int:
        """Number of segments, M."""
        return len(self.offsets) - 1

    @property
    def n_edges(self) -> IntArray:
        """Bin edges up to the far one of the last bin with a candidate, (M,) int64, or 0."""
        first, stop = self.offsets[:-1], self.offsets[1:]
        if len(self.bin) == 0:
            return np.zeros(len(stop), dtype=np.int64)
        # The index wraps around in leading segments without a candidate.
        return np.where(stop > first, self.bin[stop - 1] + 2, 0)

    @classmethod
    def buffers(cls, n: int, n_segments: int) -> Candidates:
        """Arrays for at most `n` candidates, with arbitrary content."""
        r, z, density, x, y = (np.empty(n) for _ in range(5))
        places, offsets = np.empty(n, np.int64), np.empty(n_segments + 1, np.int64)
        return cls(r, z, places, density, offsets, np.empty(n, np.int32), x, y)

    def first(self, n: int) -> Candidates:
        """First `n`, to which `offsets` refer already."""
        return self._taken(slice(n), self.offsets)

    def where(self, kept: BoolArray) -> Candidates:
        """Those of the (C,) bool mask `kept`."""
        before = np.concatenate([[0], np.cumsum(kept)])
        return self._taken(kept, before[self.offsets])

    def _taken(self, kept: Any, offsets: IntArray) -> Candidates:
        columns = self._asdict() | {'offsets': offsets}
        return Candidates(**{k: v if k == 'offsets' else v[kept] for k, v in columns.items()})


class Scan(NamedTuple):
    """Points of a level frame, sorted into the polar grid and into tiles."""

    xyz: PointArray  # (N, 3) points [m], each coordinate contiguous (Fortran order), read-only
    grid: PolarGrid  # cells of the points
    tiles: Tiles  # tiles of the points
    candidates: Candidates  # lowest point of each occupied cell
    extent: FloatArray  # (M * n_bins,) height of each cell's points [m]; -inf where there is none


class Faces(NamedTuple):
    """Tiles that hold a vertical face: a wall, a fence, the side of a car."""

    # (T + 1,) whether the returns of the tile form a vertical face; the last one, which `OUTSIDE`
    # is the index of, is for points in no tile
    is_face: BoolArray
    # (T + 1,) whether even the lowest returns belong to the face: the tile shows no ground
    has_occluded_base: BoolArray
    # (T + 1,) whether the returns above the lowest are steeper than terrain: no way leads over it
    is_steep: BoolArray

    @classmethod
    def none(cls, tiles: Tiles) -> Faces:
        """No tile has one."""
        return cls(*np.zeros((3, len(tiles.place) + 1), dtype=np.bool_))


class Lines(NamedTuple):
    """Extracted lines of all segments."""

    line: IntArray  # (C,) line of each candidate
    slope: FloatArray  # (Q,) slope dz/dr of each line; NaN for a line of one point
    start: IntArray  # (Q + 1,) candidates of line q are ``start[q]:start[q + 1]``


class PseudoInputs(NamedTuple):
    """Pseudo-inputs of the latent process."""

    r_bar: FloatArray  #: (P,) ranges [m], increasing in each segment
    log_extent: FloatArray  #: (P,) log extent of the line of each, first guess of L-bar [log m]
    offsets: IntArray  #: (M + 1,) pseudo-inputs of segment m are ``offsets[m]:offsets[m + 1]``
    line: IntArray  #: (P,) number of the line that each is on
    #: (P,) class of the line of each; those of a class share an entry of L-bar, ``theta[5 + k]``
    kind: IntArray


class Frame(NamedTuple):
    """Data that the two processes are fitted to."""

    candidates: Candidates
    lines: Lines
    pseudo: PseudoInputs
    onward: FloatArray  # (C,) slope with which the ground goes on behind, -inf where it does not
    land: BoolArray  # (C,) whether what lies on both sides is as high, too wide for an object
    in_face: BoolArray  # (C,) whether the tile of a candidate has a vertical face
    knots: FloatArray  # (K,) ranges where the surface is wanted [m], read-only
    prior_mean: float  # prior mean of the ground's height [m]


class Inliers(NamedTuple):
    """Inliers and pseudo-inputs that the hyper-parameters are learned from."""

    offsets: IntArray  # (M + 1,) inliers of segment m are ``offsets[m]:offsets[m + 1]``
    r: FloatArray  # (n,) ranges [m]
    z: FloatArray  # (n,) heights about the prior mean [m]
    # (n,) log length-scales where no latent process gives them [log m]
    log_length_scale: FloatArray
    bar_offsets: IntArray  # (M + 1,) pseudo-inputs of segment m; all zero without a latent process
    r_bar: FloatArray  # (P,) ranges of the pseudo-inputs [m]
    log_extent: FloatArray  # (P,) their first guesses of the log length-scale [log m]
    kind: IntArray  # (P,) class of each


class GroundSurface(NamedTuple):
    """Ground height over range in every segment."""

    knots: FloatArray  #: (K,) ranges [m]: the bin edges
    #: (M, K) height of the ground over the relief [m]; NaN in segments without a model, behind the
    #: last bin with a return in a segment
    mean: FloatArray
    std: FloatArray  #: (M, K) its standard deviation [m]; NaN in the same places
    inlier: BoolArray  #: (C,) candidates that the surface rests on


def at_points(knots: FloatArray, table: FloatArray, grid: PolarGrid) -> PointArray:
    """Value under each point, (N,), in the precision of the points.

    `knots` (K,) are ranges [m], `table` (M, K) the values there, linear between the knots; nearer
    than the first knot it is the first knot's. NaN beyond the last knot.
    """
    level, slope = linear_pieces(knots, table, grid.r.dtype).T
    cell = as_index(grid.cell)
    value: PointArray = slope[cell] * np.maximum(grid.r, grid.r.dtype.type(knots[0]))
    value += level[cell]
    return value


def linear_pieces(
    knots: FloatArray, table: FloatArray, dtype: np.dtype[np.floating]
) -> PointArray:
    """Line across each cell: its value at range 0 and its slope, (M * n_bins + 1, 2) of `dtype`.

    `knots` (K,) are ranges [m], `table` (M, K) the values there, linear between them. The last
    line, which `OUTSIDE` is the index of, is NaN.
    """
    slope = np.diff(table) / np.diff(knots)
    level = table[:, :-1] - slope * knots[:-1]
    pieces = np.full((slope.size + 1, 2), np.nan, dtype)
    pieces[:-1, 0], pieces[:-1, 1] = level.ravel(), slope.ravel()
    return pieces


class Labelled(NamedTuple):
    """Labels of a scan and what they follow from."""

    # (N,) `Label` of each point; UNKNOWN for points that are not finite
    label: npt.NDArray[np.uint8]
    # (N,) height of each point over the surface [m], in the precision of the points; NaN where
    # there is none
    height: PointArray
    # (N,) distance of each point to the nearer edge of the band that is ground [m], negative for
    # obstacles; NaN where there is no surface
    margin: PointArray
