"""Which semantic classes the errors lie on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gp_ground_seg.evaluation.conventions import GROUNDGRID, Convention
from gp_ground_seg.evaluation.scores import ClassCount
from gp_ground_seg.frame import Label


@dataclass(frozen=True)
class ClassErrors:
    """Errors on the points of one class.

    Attributes
    ----------
    number : int
        The class.
    truth : Label
        What it counts as.
    points : int
        How many there are.
    labelled_ground : int
        How many of them were labelled ground.
    """

    number: int
    truth: Label
    points: int
    labelled_ground: int

    @property
    def missed(self) -> int:
        """Points of ground that were not labelled ground."""
        return self.points - self.labelled_ground if self.truth is Label.GROUND else 0

    @property
    def false(self) -> int:
        """Points of an obstacle that were labelled ground."""
        return self.labelled_ground if self.truth is Label.OBSTACLE else 0

    @property
    def errors(self) -> int:
        """Both."""
        return self.missed + self.false


def class_errors(
    classes: Mapping[int, ClassCount], convention: Convention = GROUNDGRID
) -> list[ClassErrors]:
    """Errors by class, those that cost most first.

    Parameters
    ----------
    classes : mapping of int to ClassCount
        Counts by class number.
    convention : Convention
        What counts as ground; vegetation only as a whole (see `Convention.truth_of_class`).
    """
    found = [
        ClassErrors(number, convention.truth_of_class(number), count.points, count.labelled_ground)
        for number, count in classes.items()
    ]
    return sorted(found, key=lambda one: (-one.errors, -one.points, one.number))
