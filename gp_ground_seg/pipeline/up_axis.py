"""Clouds whose z axis does not point up: which axis does, and the angles to put it right."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gp_ground_seg.compiled.plane_passes import plane_below
from gp_ground_seg.frame import Candidates, FloatArray
from gp_ground_seg.pipeline.ground_plane import GroundPlane
from gp_ground_seg.pipeline.tilt import angles_of, rotation

MAX_TILT = math.radians(46.0)
"""How far from an axis up is looked for; these cones leave no direction out."""
POOR, GOOD = 0.35, 0.9
"""Support of the plane below z under which another axis is looked for: near, and `TALL`."""
MIN_SUPPORT = 0.5
"""Share of the low cells on a plane from which it shows where the ground is."""
TWICE, ALIKE = 2.0, 0.8
"""How much of its support another plane must have: near, and `TALL`."""
NEARER = 3.0
"""How much nearer another plane must be than a `TALL` one."""
TALL = 6.0
"""Height from which the plane below z may well be a facade [m]."""
WORTH_A_LOOK = 0.15
"""Support from which a plane is looked at again, with itself level."""
STILL_UP = math.radians(25.0)
"""Tilt below which z is up all the same."""
MIN_CELLS = 60
"""Cells that there must be for it."""
MIN_COVERAGE = 0.25
MIN_FAR_COVERAGE = 0.5
"""Share of the sectors in which it must reach far: the ceiling of a room is no ground."""
MIN_SPREAD = 0.06
"""Spread of the angles of depression [rad]: more than one beam."""

_QUARTER = math.pi / 2.0
_TURNS = (
    (0.0, 0.0),
    (math.pi, 0.0),
    (_QUARTER, 0.0),
    (-_QUARTER, 0.0),
    (0.0, _QUARTER),
    (0.0, -_QUARTER),
)
"""Roll and pitch that turn each of the six axes up [rad]."""


def is_suspicious(plane: GroundPlane | None) -> bool:
    """Whether the plane below z is so poor, or so far away, that z may not be up."""
    return plane is None or plane.support < POOR or (_is_tall(plane) and plane.support < GOOD)


def _is_tall(plane: GroundPlane | None) -> bool:
    return plane is not None and plane.height > TALL


def _is_ground(plane: GroundPlane, support: float) -> bool:
    return (
        plane.support >= support
        and plane.n_cells >= MIN_CELLS
        and plane.coverage >= MIN_COVERAGE
        and plane.far_coverage >= MIN_FAR_COVERAGE
        and plane.spread >= MIN_SPREAD
    )


def other_way_up(
    given: FloatArray,
    plane: GroundPlane | None,
    use_compiled: bool,
    candidates_turned: Callable[[FloatArray], Candidates],
) -> str | None:
    """Say in one line where the ground clearly lies if not along z; None if it does not.

    Parameters
    ----------
    given : (3, 3) float64
        Rotation from the sensor frame to the frame looked at, in which z should be up.
    plane : GroundPlane or None
        What was found there.
    use_compiled : bool
        Compiled code, or its twin in numpy.
    candidates_turned : callable
        Returns the candidates of the scan, turned from that frame by a matrix (3, 3);
        a sample of its points will do.

    Returns
    -------
    str or None
        The axis that seems to be up, and the angles to set.
    """
    support = 0.0 if plane is None else plane.support
    needed = max(MIN_SUPPORT, (ALIKE if _is_tall(plane) else TWICE) * support)
    farthest = plane.height / NEARER if plane is not None and _is_tall(plane) else math.inf

    def look(turn: FloatArray) -> GroundPlane | None:
        return plane_below(candidates_turned(turn), math.tan(MAX_TILT), use_compiled)

    best: tuple[float, FloatArray, float] | None = None
    for angles in _TURNS:
        turn = rotation(*angles)
        first = look(turn)
        if first is None or first.support < WORTH_A_LOOK:
            continue
        # Again with that plane level: the lowest points of a tilted cell are not all ground.
        turn = rotation(*angles_of(turn.T @ first.up))
        other = look(turn)
        if other is not None and other.height <= farthest and _is_ground(other, needed):
            clarity = other.support * other.far_coverage
            if best is None or clarity > best[0]:
                up = turn.T @ other.up
                best = clarity, up, other.height * float(other.up[2])
    if best is None or best[1][2] > math.cos(STILL_UP):
        return None
    _, up, height = best
    up = given.T @ up
    roll, pitch = (round(angle, 3) + 0.0 for angle in angles_of(up))
    largest = int(np.argmax(np.abs(up)))
    axis = f'{"-" if up[largest] < 0.0 else ""}{"xyz"[largest]}'
    return (
        f'z does not point up: the ground seems to be {height:.2f} m away with {axis} up; turn '
        f'the cloud, or set sensor.roll to {roll:.3f} and sensor.pitch to {pitch:.3f} [rad]'
    )
