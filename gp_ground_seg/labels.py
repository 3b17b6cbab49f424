"""Class of a point after segmentation."""

from enum import IntEnum


class Label(IntEnum):
    """Class of a point; the values are what ``Segmentation.label`` holds."""

    UNKNOWN = 0
    GROUND = 1
    OBSTACLE = 2
