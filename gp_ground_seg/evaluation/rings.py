"""Scores by horizontal range: where a method fades."""

from __future__ import annotations

import itertools
import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.evaluation.scores import Confusion
from gp_ground_seg.frame import Label

RING_EDGES = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, math.inf)
"""Edges of the rings [m]; each holds its inner edge, not its outer one."""


def ring_titles() -> tuple[str, ...]:
    """Names of the rings, as in ``10-20 m``."""
    return tuple(
        f'> {low:g} m' if math.isinf(high) else f'{low:g}-{high:g} m'
        for low, high in itertools.pairwise(RING_EDGES)
    )


def count_rings(
    label: npt.NDArray[np.uint8],
    truth: npt.NDArray[np.uint8],
    points: npt.NDArray[np.floating],
) -> tuple[Confusion, ...]:
    """Compare given with true labels, ring by ring.

    Parameters
    ----------
    label, truth : (N,) uint8
        As `count_confusion`.
    points : (N, >=2) float
        x, y, ... in the sensor frame [m]. A point without a finite range is in
        no ring.

    Returns
    -------
    tuple of Confusion
        One for each ring of `RING_EDGES`.
    """
    xy = points[:, :2].astype(np.float64)
    reach = np.hypot(xy[:, 0], xy[:, 1])
    n_rings = len(RING_EDGES) - 1
    ring = np.digitize(reach, RING_EDGES[1:-1])
    scored = np.isfinite(reach) & ((truth == Label.GROUND) | (truth == Label.OBSTACLE))
    given, ground = label == Label.GROUND, truth == Label.GROUND
    code = 4 * ring + 2 * given + ground
    counts = np.bincount(code[scored], minlength=4 * n_rings).reshape(n_rings, 4)
    return tuple(
        Confusion(tp=int(tp), fp=int(fp), fn=int(fn), tn=int(tn)) for tn, fn, fp, tp in counts
    )
