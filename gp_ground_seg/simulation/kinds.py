"""What a ray can hit, and the SemanticKITTI class it stands for."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt


class Kind(IntEnum):
    """What a ray hit."""

    TERRAIN = 0
    BOX = 1
    WALL = 2
    POLE = 3
    OVERHANG = 4
    REFLECTION = 5
    VEGETATION = 6


SEMANTIC_KITTI_CLASS: dict[Kind, int] = {
    Kind.TERRAIN: 40,  # road
    Kind.BOX: 10,  # car
    Kind.WALL: 50,  # building
    Kind.POLE: 80,  # pole
    Kind.OVERHANG: 52,  # other structure; scored as an obstacle, unlike vegetation
    Kind.REFLECTION: 1,  # outlier
    Kind.VEGETATION: 70,  # vegetation
}

# Share of the light that comes back: only so that intensity is not constant.
REFLECTANCE: dict[Kind, float] = {
    Kind.TERRAIN: 0.25,
    Kind.BOX: 0.5,
    Kind.WALL: 0.4,
    Kind.POLE: 0.6,
    Kind.OVERHANG: 0.35,
    Kind.REFLECTION: 0.05,
    Kind.VEGETATION: 0.3,
}


def semantic_kitti_labels(kind: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint32]:
    """Class in SemanticKITTI of each `Kind` code, (N,) uint32, as ``.label`` files hold them."""
    table = np.array([SEMANTIC_KITTI_CLASS[entry] for entry in Kind], dtype=np.uint32)
    return table[kind]


def reflectance(kind: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """Share of the light that each `Kind` code sends back, (N,) float64 in [0, 1]."""
    return np.array([REFLECTANCE[entry] for entry in Kind])[kind]
