"""What passes from stage to stage of a frame: arrays with their shapes and units."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


PointArray = npt.NDArray[np.floating]
"""Coordinates, in single or double precision."""


IntArray = npt.NDArray[np.int64]


OUTSIDE = -1
"""Bin and cell of a point that is beyond the grid."""


NOT_FINITE = -2
"""Cell of a point that is not finite."""


NO_TILE = 2**31 - 1
"""Tile of the lowest point of an empty cell."""


BoolArray = npt.NDArray[np.bool_]


CellArray = npt.NDArray[np.int32]


class Label(IntEnum):
    """Class of a point; the values are what ``Segmentation.label`` holds."""

    UNKNOWN = 0
    GROUND = 1
    OBSTACLE = 2


@dataclass(frozen=True)
class PolarGrid:
    """Where each point lies in the radial grid.

    Attributes
    ----------
    cell : (N,) int32
        Cell ``segment * n_bins + bin``, or `OUTSIDE`, or `NOT_FINITE`.
    r : (N,) float32 or float64
        Horizontal range [m], in the precision of the points; NaN for points that are
        not finite.
    edges : (n_bins + 1,) float64
        Range of the bin edges [m].
    n_segments : int
        Number of segments M.
    """

    cell: npt.NDArray[np.int32]
    r: PointArray
    edges: FloatArray
    n_segments: int

    @property
    def n_bins(self) -> int:
        """Bins of each segment."""
        return len(self.edges) - 1

    @property
    def inside(self) -> npt.NDArray[np.bool_]:
        """Which points lie in a cell, (N,) bool."""
        return self.cell >= 0

    @cached_property
    def segment(self) -> IntArray:
        """Angular segment of each point, counter-clockwise from -x, (N,) int64; 0 outside."""
        return np.maximum(self.cell, 0).astype(np.int64) // self.n_bins

    @cached_property
    def bin(self) -> IntArray:
        """Radial bin of each point, (N,) int64, or `OUTSIDE`."""
        own = self.cell.astype(np.int64) % self.n_bins
        return np.where(self.inside, own, OUTSIDE)


@dataclass(frozen=True)
class Candidates:
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
        Tile that each of them lies in (see `gp_ground_seg.pipeline.tiles.Tiles`).
    """

    r: FloatArray
    z: FloatArray
    bin: IntArray
    density: FloatArray
    offsets: IntArray
    tile: npt.NDArray[np.int32]

    @property
    def segment(self) -> IntArray:
        """Segment of each candidate, (C,) int64."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))

    def where(self, kept: npt.NDArray[np.bool_]) -> Candidates:
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

    @property
    def n_edges(self) -> IntArray:
        """Bin edges up to the far one of the last bin with a candidate, (M,) int64, or 0."""
        first, stop = self.offsets[:-1], self.offsets[1:]
        if len(self.bin) == 0:
            return np.zeros(len(stop), dtype=np.int64)
        # Of leading segments without a candidate this is the last of all: they get 0 below.
        result: IntArray = self.bin[stop - 1]
        result += 2
        result *= stop > first
        return result


@dataclass(frozen=True)
class Tiles:
    """Where each point lies in a square of square tiles that holds the polar grid.

    Attributes
    ----------
    tile : (N,) int32
        Tile of each point, or `OUTSIDE`.
    extremes : (T, 2) float32 or float64
        Height of the lowest and of the highest point of each tile [m], in the
        precision of the points; infinite, minus infinite in empty ones.
    touched : (K,) int32
        Tiles with a point, in any order.
    """

    tile: npt.NDArray[np.int32]
    extremes: npt.NDArray[np.floating]
    touched: npt.NDArray[np.int32]

    @property
    def foot_z(self) -> npt.NDArray[np.floating]:
        """Height of the lowest point of each tile, (T,) [m]."""
        value: npt.NDArray[np.floating] = self.extremes[:, 0]
        return value


@dataclass(frozen=True)
class Faces:
    """Which square tiles of the plane an upright face stands in.

    Attributes
    ----------
    tiles : Tiles
        Tiles of the points.
    is_face : (T,) bool
        Whether the returns of the tile are an upright face.
    is_footless : (T,) bool
        Whether they are one down to the lowest: no ground is seen in the tile. See
        `gp_ground_seg.pipeline.hidden_feet`.
    """

    tiles: Tiles
    is_face: npt.NDArray[np.bool_]
    is_footless: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Lines:
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

    def continued(self, max_slope: float, min_size: int) -> npt.NDArray[np.bool_]:
        """Candidates that continue the line of the one before them, (C,) bool.

        Of lines that are no steeper than `max_slope` and have at least `min_size`
        candidates: what is longer and flatter than an obstacle, and hangs together.
        """
        counts = (np.abs(self.slope) <= max_slope) & (np.diff(self.start) >= min_size)
        result: npt.NDArray[np.bool_] = counts[self.line]
        result[self.start[:-1]] = False
        return result


N_CLASSES = 9
"""Surface classes: flat, sloped, steep times short, medium, long."""


@dataclass(frozen=True)
class PseudoInputs:
    """Pseudo-inputs of all segments; those of one surface class share a log length-scale.

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


@dataclass(frozen=True)
class GroundSurface:
    """Ground height over range in every segment.

    Attributes
    ----------
    knots : (K,) float64
        Ranges [m]: the bin edges.
    mean, std : (M, K) float64
        Ground height in the sensor frame and its standard deviation [m]; NaN in
        segments without a model, and behind the last bin with a return in a segment
        and in those that are fused with it.
    inlier : (C,) bool
        Candidates that made the surface.
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
            level, slope = pieces(self.knots, table)
            value = level[cell] + slope[cell] * away
            value[outside] = np.nan
            values.append(value)
        return values[0], values[1]


def pieces(knots: FloatArray, table: FloatArray) -> tuple[FloatArray, FloatArray]:
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


@dataclass(frozen=True)
class Labelled:
    """Labels of a scan and what they follow from.

    Attributes
    ----------
    label : (N,) uint8
        See `label_points`.
    height : (N,) float64
        Height of each point over the surface [m]; NaN where there is none.
    margin : (N,) float64
        See `label_points` [m].
    roughness : (M, n_bins) float64
        See `local_roughness` [m].
    """

    label: npt.NDArray[np.uint8]
    height: FloatArray
    margin: FloatArray
    roughness: FloatArray
