"""A scan that is sorted into bins and tiles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gp_ground_seg.frame import Candidates, Faces, PointArray, PolarGrid


@dataclass(frozen=True)
class SortedPoints:
    """Points of a level frame and what follows from where they lie.

    Attributes
    ----------
    xyz : (N, 3) float32 or float64
        Points [m], read-only.
    grid : PolarGrid
        Their bins.
    candidates : Candidates
        Ground candidates.
    find_faces : callable
        Returns upright faces; other threads may have been looking for them.
    drop_faces : callable
        Waits until nobody looks for them, to be called where they are not wanted.
    """

    xyz: PointArray
    grid: PolarGrid
    candidates: Candidates
    find_faces: Callable[[], Faces]
    drop_faces: Callable[[], None]
