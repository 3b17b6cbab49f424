"""Analytic terrain: height, slope and bend at any point, piece by piece.

Every terrain is smooth on pieces that lie between parallel break lines. The ray
caster (`raycast`) crosses one piece at a time, so kinks and vertical steps are met
exactly, and within a piece a bound on the bend along the ray keeps its steps safe.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.simulation.sensor import FloatArray


class Along(NamedTuple):
    """The terrain below a point that moves along a line; arrays of shape (R,).

    Attributes
    ----------
    height : array
        Height z [m].
    slope : array
        Change of the height per unit of travel.
    bend : array
        Upper bound, over the whole piece, of the second derivative of the height.
    """

    height: FloatArray
    slope: FloatArray
    bend: FloatArray


class Terrain(ABC):
    """A surface z(x, y); `+` adds two of them."""

    @abstractmethod
    def along(
        self, at: FloatArray, direction: FloatArray, piece: FloatArray | None = None
    ) -> Along:
        """Terrain below points that move.

        Parameters
        ----------
        at : (R, 2) array
            x, y of the points [m].
        direction : (R, 2) array
            dx, dy per unit of travel.
        piece : (R, 2) array, optional
            Points inside the smooth piece meant; it is continued to `at`. By default
            the piece `at` lies in (on a break line the one on its far side).
        """

    @abstractmethod
    def breaks(self) -> FloatArray:
        """Break lines as rows a, b, c of ``a x + b y = c``, (B, 3)."""

    @abstractmethod
    def ceiling(self) -> Terrain:
        """Terrain without waves that is nowhere below this one."""

    def height(self, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
        """Exact height [m] at x, y [m]; scalars or arrays of one shape."""
        at = np.stack(np.broadcast_arrays(x, y), axis=-1).astype(np.float64)
        flat = at.reshape(-1, 2)
        return self.along(flat, np.zeros_like(flat)).height.reshape(at.shape[:-1])

    def gradient(self, at: FloatArray) -> FloatArray:
        """Slope in x and in y at points (R, 2) [m], (R, 2)."""
        by_axis = [self.along(at, np.broadcast_to(axis, at.shape)).slope for axis in np.eye(2)]
        return np.stack(by_axis, axis=-1)

    def __add__(self, other: Terrain) -> Terrain:
        """Terrain whose heights are the sums of the two."""
        return _Sum((*_terms(self), *_terms(other)))


@dataclass(frozen=True, eq=False)
class Profile(Terrain):
    """Terrain that changes along one heading only: parabolas between parallel break lines.

    Over u = x cos(heading) + y sin(heading), piece k reaches up to ``edges[k]`` and is
    z = c0 + c1 (u - anchor) + c2 (u - anchor)^2.

    Attributes
    ----------
    heading : float
        Direction of u [rad].
    edges : (B,) array
        Ascending u of the break lines [m].
    anchor : (B + 1,) array
        Reference u of each piece [m].
    coefficients : (B + 1, 3) array
        c0 [m], c1, c2 [1/m] of each piece.
    """

    heading: float
    edges: FloatArray
    anchor: FloatArray
    coefficients: FloatArray

    def along(
        self, at: FloatArray, direction: FloatArray, piece: FloatArray | None = None
    ) -> Along:
        """Terrain below points that move; see `Terrain.along`."""
        axis = self._axis
        u, du = at @ axis, direction @ axis
        if len(self.edges):
            k = self.piece_index(at if piece is None else piece)
            anchor, (c0, c1, c2) = self.anchor[k], self.coefficients[k].T
        else:
            anchor, (c0, c1, c2) = self.anchor[0], self.coefficients[0]
        v = u - anchor
        return Along(c0 + v * (c1 + v * c2), du * (c1 + 2.0 * c2 * v), 2.0 * c2 * du**2)

    def piece_index(self, at: FloatArray) -> npt.NDArray[np.intp]:
        """Piece in which points (R, 2) lie, (R,)."""
        return np.searchsorted(self.edges, at @ self._axis, side='right')

    def breaks(self) -> FloatArray:
        """Edges of the pieces, (B, 3)."""
        return np.column_stack([np.broadcast_to(self._axis, (len(self.edges), 2)), self.edges])

    def ceiling(self) -> Terrain:
        """Return itself: it has no waves."""
        return self

    @property
    def _axis(self) -> FloatArray:
        return np.array([math.cos(self.heading), math.sin(self.heading)])


@dataclass(frozen=True, eq=False)
class _Sum(Terrain):
    """Sum of terrains."""

    terms: tuple[Terrain, ...]

    def along(
        self, at: FloatArray, direction: FloatArray, piece: FloatArray | None = None
    ) -> Along:
        parts = [term.along(at, direction, piece) for term in self.terms]
        height, slope, bend = (sum(values) for values in zip(*parts, strict=True))
        return Along(np.asarray(height), np.asarray(slope), np.asarray(bend))

    def breaks(self) -> FloatArray:
        return np.unique(np.concatenate([term.breaks() for term in self.terms]), axis=0)

    def ceiling(self) -> Terrain:
        return _Sum(tuple(term.ceiling() for term in self.terms))


def _terms(terrain: Terrain) -> tuple[Terrain, ...]:
    return terrain.terms if isinstance(terrain, _Sum) else (terrain,)
