"""What counts as ground: the two scoring conventions of the field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.evaluation.semantic_classes import SemanticClass
from gp_ground_seg.frame import Label

SENSOR_HEIGHT = 1.73
"""Height of the sensor [m] in SemanticKITTI. The truth is a property of the data:
it must not move with ``sensor.height``, which is a parameter of the method."""

LOW_VEGETATION_Z = -0.75 * SENSOR_HEIGHT
"""Height [m, sensor frame] below which Patchwork's evaluation counts vegetation as ground."""

GROUND_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.PARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.OTHER_GROUND,
    SemanticClass.LANE_MARKING,
    SemanticClass.TERRAIN,
)


@dataclass(frozen=True)
class Convention:
    """A way to read semantic classes as ground and not ground.

    Attributes
    ----------
    key : str
        Name in files.
    title : str
        Name in tables.
    rule : str
        What it does, in a few words.
    left_out : tuple of int
        Classes whose points do not count.
    low_vegetation_z : float or None
        Vegetation below this height [m, sensor frame] is ground.
    """

    key: str
    title: str
    rule: str
    left_out: tuple[int, ...]
    low_vegetation_z: float | None = None

    def truth(
        self, semantic: npt.NDArray[np.integer], z: npt.NDArray[np.floating]
    ) -> npt.NDArray[np.uint8]:
        """Return the true label of each point.

        Parameters
        ----------
        semantic : (N,) int
            Classes.
        z : (N,) float
            Heights in the sensor frame [m].

        Returns
        -------
        (N,) uint8
            ``Label.GROUND``, ``Label.OBSTACLE``, or ``Label.UNKNOWN`` where the
            point does not count.
        """
        ground = np.isin(semantic, GROUND_CLASSES)
        if self.low_vegetation_z is not None:
            ground |= (semantic == SemanticClass.VEGETATION) & (z < self.low_vegetation_z)
        truth = np.where(ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
        truth[np.isin(semantic, self.left_out)] = Label.UNKNOWN
        return truth

    def truth_of_class(self, number: int) -> Label:
        """Return the true label of a class, of its high points if that depends on height."""
        (truth,) = self.truth(np.array([number]), np.array([np.inf]))
        return Label(truth)


GROUNDGRID = Convention(
    'groundgrid',
    'GroundGrid',
    'vegetation left out',
    (SemanticClass.UNLABELLED, SemanticClass.OUTLIER, SemanticClass.VEGETATION),
)
"""Steinke et al., "GroundGrid: LiDAR Point Cloud Ground Segmentation and Terrain Estimation",
RA-L 2024. Our headline."""

PATCHWORK = Convention(
    'patchwork',
    'Patchwork',
    f'vegetation below {LOW_VEGETATION_Z:.2f} m is ground, above it an obstacle',
    (SemanticClass.UNLABELLED, SemanticClass.OUTLIER),
    LOW_VEGETATION_Z,
)
"""Lim et al., "Patchwork: Concentric Zone-Based Region-Wise Ground Segmentation With Ground
Likelihood Estimation Using a 3D LiDAR Sensor", RA-L 2021. The threshold, -3/4 of the sensor's
height, is that of its published evaluation code."""

CONVENTIONS = (GROUNDGRID, PATCHWORK)
