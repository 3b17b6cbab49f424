"""The frames a method did worst on, with their labels."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.evaluation.conventions import GROUNDGRID
from gp_ground_seg.evaluation.scores import FrameScore


@dataclass(frozen=True)
class LabelledFrame:
    """A frame, its score, and the labels it got, (N,) uint8."""

    frame: Frame
    score: FrameScore
    label: npt.NDArray[np.uint8]

    @property
    def iou(self) -> float:
        """Score in the GroundGrid convention; NaN where there is nothing to score."""
        return self.score.confusions[GROUNDGRID.key].iou


class WorstFrames:
    """Keeps the labels of the frames with the lowest IoU, and of no others.

    Parameters
    ----------
    method : str
        Name of the method whose frames are looked at.
    n : int
        How many to keep.
    """

    def __init__(self, method: str, n: int) -> None:
        self._method = method
        self._n = n
        self._n_seen = 0
        self._heap: list[tuple[float, int, LabelledFrame]] = []

    def see(
        self, method: str, frame: Frame, score: FrameScore, label: npt.NDArray[np.uint8]
    ) -> None:
        """Look at a frame just scored; one without a defined IoU is passed over."""
        kept = LabelledFrame(frame, score, label)
        if method != self._method or math.isnan(kept.iou):
            return
        self._n_seen += 1
        heapq.heappush(self._heap, (-kept.iou, -self._n_seen, kept))
        if len(self._heap) > self._n:
            heapq.heappop(self._heap)

    def found(self) -> list[LabelledFrame]:
        """Return the frames, the worst first."""
        return [kept for *_, kept in sorted(self._heap, key=lambda entry: entry[:2], reverse=True)]
