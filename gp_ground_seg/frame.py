"""Values that pass from stage to stage of a frame: arrays with their shapes and units.

Named tuples, because compiled code reads their fields as numpy code does. Ragged arrays are
values and `offsets`: those of segment m are ``offsets[m]:offsets[m + 1]``.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
CellArray = npt.NDArray[np.int32]
BoolArray = npt.NDArray[np.bool_]
PointArray = npt.NDArray[np.floating]
"""Coordinates, in single or double precision."""

OUTSIDE = -1
"""Bin, cell and tile of a point that is beyond the grid."""
NOT_FINITE = -2
"""Cell of a point that is not finite."""
NO_TILE = 2**31 - 1
"""Tile of the lowest point of an empty cell."""
N_CLASSES = 9
"""Surface classes: flat, sloped, steep times short, medium, long."""


class Label(IntEnum):
    """Class of a point; the values are what ``Segmentation.label`` holds."""

    UNKNOWN = 0
    GROUND = 1
    OBSTACLE = 2


class PolarGrid(NamedTuple):
    """Where each point lies in the radial grid.

    Attributes
    ----------
    cell : (N,) int32
        Cell ``segment * n_bins + bin``, or `OUTSIDE`, or `NOT_FINITE`.
    r : (N,) float32 or float64
        Horizontal range [m], in the precision of the points; NaN for points that are
        not finite.
    edges : (n_bins + 1,) float64
        Range of the bin edges [m], read-only.
    n_segments : int
        Number of segments M.
    """

    cell: CellArray
    r: PointArray
    edges: FloatArray
    n_segments: int

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
        own = self.cell.astype(np.int64) % self.n_bins
        return np.where(self.inside, own, OUTSIDE)


class Tiles(NamedTuple):
    """Where each point lies in a square of square tiles that holds the polar grid.

    Attributes
    ----------
    tile : (N,) int32
        Tile of each point, or `OUTSIDE`.
    extremes : (T, 2) float32 or float64
        Height of the lowest and of the highest point of each tile [m], in the
        precision of the points; infinite, minus infinite in empty ones.
    occupied : (K,) int32
        Tiles with a point, in any order.
    """

    tile: CellArray
    extremes: PointArray
    occupied: CellArray

    @property
    def lowest_z(self) -> PointArray:
        """Height of the lowest point of each tile, (T,) [m]."""
        value: PointArray = self.extremes[:, 0]
        return value


class Candidates(NamedTuple):
    """Ground candidates PG_m of all segments, near to far in each.

    Attributes
    ----------
    r, z : (C,) float64
        Horizontal range and height [m] of the lowest point of each occupied bin.
    bin : (C,) int64
        Bin of each candidate.
    density : (C,) float64
        Vertical density of each candidate's bin [points/m^2].
    offsets : (M + 1,) int64
        Candidates of segment m are ``offsets[m]:offsets[m + 1]``.
    tile : (C,) int32
        Tile of each candidate.
    """

    r: FloatArray
    z: FloatArray
    bin: IntArray
    density: FloatArray
    offsets: IntArray
    tile: CellArray

    @property
    def segment(self) -> IntArray:
        """Segment of each candidate, (C,) int64."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))

    @property
    def n_edges(self) -> IntArray:
        """Bin edges up to the far one of the last bin with a candidate, (M,) int64, or 0."""
        first, stop = self.offsets[:-1], self.offsets[1:]
        if len(self.bin) == 0:
            return np.zeros(len(stop), dtype=np.int64)
        # The index wraps around in leading segments without a candidate; they get 0 below.
        result: IntArray = self.bin[stop - 1]
        result += 2
        result *= stop > first
        return result

    def where(self, kept: BoolArray) -> Candidates:
        """Those of the (C,) bool mask `kept`."""
        before = np.concatenate([[0], np.cumsum(kept)])
        return Candidates(
            self.r[kept],
            self.z[kept],
            self.bin[kept],
            self.density[kept],
            before[self.offsets],
            self.tile[kept],
        )


class Scan(NamedTuple):
    """Points of a level frame, sorted into the polar grid and into tiles.

    Attributes
    ----------
    xyz : (N, 3) float32 or float64
        Points [m], each coordinate contiguous (Fortran order), read-only.
    grid : PolarGrid
        Cells of the points.
    tiles : Tiles
        Tiles of the points.
    candidates : Candidates
        Lowest point of each occupied cell.

    `xyz` and `tiles` may lie in buffers of the backend, which its next scan reuses.
    """

    xyz: PointArray
    grid: PolarGrid
    tiles: Tiles
    candidates: Candidates


class Faces(NamedTuple):
    """Tiles that hold a vertical face: a wall, a fence, a kerb, the side of a car.

    Attributes
    ----------
    is_face : (T,) bool
        Whether the returns of the tile form a vertical face.
    has_occluded_base : (T,) bool
        Whether even the lowest returns belong to the face, so that no ground is seen in
        the tile.
    """

    is_face: BoolArray
    has_occluded_base: BoolArray


class Lines(NamedTuple):
    """Extracted lines of all segments.

    Attributes
    ----------
    line : (C,) int64
        Line of each candidate.
    slope : (Q,) float64
        Slope dz/dr of each line; NaN for a line of one point.
    start : (Q + 1,) int64
        Candidates of line q are ``start[q]:start[q + 1]``.
    """

    line: IntArray
    slope: FloatArray
    start: IntArray

    def extent(self, candidates: Candidates) -> FloatArray:
        """Horizontal extent of each line, (Q,) float64 [m]."""
        value: FloatArray = candidates.r[self.start[1:] - 1] - candidates.r[self.start[:-1]]
        return value


class PseudoInputs(NamedTuple):
    """Pseudo-inputs of the latent process; those of one surface class share a log length-scale.

    Attributes
    ----------
    r_bar : (P,) float64
        Ranges [m], increasing in each segment.
    surface_class : (P,) int64
        Surface class, 0 to `N_CLASSES` - 1.
    offsets : (M + 1,) int64
        Pseudo-inputs of segment m are ``offsets[m]:offsets[m + 1]``.
    first_guess : (N_CLASSES,) float64
        Mean log extent of the lines of each class [log m].
    """

    r_bar: FloatArray
    surface_class: IntArray
    offsets: IntArray
    first_guess: FloatArray


class Frame(NamedTuple):
    """What the two processes are fitted to.

    Attributes
    ----------
    candidates : Candidates
        Ground candidates.
    lines : Lines
        Lines through them.
    pseudo : PseudoInputs
        Pseudo-inputs on the lines.
    continues_line : (C,) bool
        Candidates that join the inliers if the one before them has joined.
    knots : (K,) float64
        Ranges where the surface is wanted [m], read-only.
    prior_mean : float
        Prior mean of the ground's height [m].
    """

    candidates: Candidates
    lines: Lines
    pseudo: PseudoInputs
    continues_line: BoolArray
    knots: FloatArray
    prior_mean: float


class Inliers(NamedTuple):
    """Inliers and pseudo-inputs that the hyper-parameters are learned from.

    Attributes
    ----------
    offsets : (M + 1,) int64
        Inliers of segment m are ``offsets[m]:offsets[m + 1]``.
    r, z : (n,) float64
        Their ranges and heights about the prior mean [m].
    log_length_scale : (n,) float64
        Their log length-scales where no latent process gives them [log m].
    bar_offsets : (M + 1,) int64
        Pseudo-inputs of segment m; all zero without a latent process.
    r_bar : (P,) float64
        Ranges of the pseudo-inputs [m].
    surface_class : (P,) int64
        Surface class of each pseudo-input.
    """

    offsets: IntArray
    r: FloatArray
    z: FloatArray
    log_length_scale: FloatArray
    bar_offsets: IntArray
    r_bar: FloatArray
    surface_class: IntArray


class GroundSurface(NamedTuple):
    """Ground height over range in every segment.

    Attributes
    ----------
    knots : (K,) float64
        Ranges [m]: the bin edges.
    mean, std : (M, K) float64
        Ground height in the level frame and its standard deviation [m]; NaN in
        segments without a model, and behind the last bin with a return in a segment
        and in those that are fused with it.
    inlier : (C,) bool
        Candidates that the surface rests on.
    """

    knots: FloatArray
    mean: FloatArray
    std: FloatArray
    inlier: BoolArray

    def at(self, grid: PolarGrid) -> tuple[FloatArray, FloatArray]:
        """Height and standard deviation [m] under each point, two (N,) float64.

        Linear between the knots; nearer than the first knot it is the first
        knot's. NaN beyond the last knot and in segments without a model.
        """
        cell = np.maximum(grid.cell, 0)
        outside = ~grid.inside
        away = np.maximum(grid.r, self.knots[0])
        values = []
        for table in (self.mean, self.std):
            level, slope = linear_pieces(self.knots, table)
            value = level[cell] + slope[cell] * away
            value[outside] = np.nan
            values.append(value)
        return values[0], values[1]


def linear_pieces(knots: FloatArray, table: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Line across each cell: its value at range 0 and its slope, two (M * n_bins,) float64.

    Parameters
    ----------
    knots : (K,) float64
        Ranges of the knots [m].
    table : (M, K) float64
        Values at the knots, linear between them.
    """
    slope = np.diff(table, axis=1) / np.diff(knots)
    return (table[:, :-1] - slope * knots[:-1]).ravel(), slope.ravel()


class Labelled(NamedTuple):
    """Labels of a scan and what they follow from.

    Attributes
    ----------
    label : (N,) uint8
        `Label` of each point; UNKNOWN for points that are not finite.
    height : (N,) float64
        Height of each point over the surface [m]; NaN where there is none.
    margin : (N,) float64
        Distance of each point to the nearer edge of the band that is ground [m], negative
        for obstacles; NaN where there is no surface.
    roughness : (M, n_bins) float64
        Root mean square height of the returns over the surface about each bin [m].
    """

    label: npt.NDArray[np.uint8]
    height: FloatArray
    margin: FloatArray
    roughness: FloatArray
