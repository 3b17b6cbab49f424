"""What the commands that write data say while they run, and at the end."""

from __future__ import annotations

import statistics
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from gp_ground_seg.cli.notes import note
from gp_ground_seg.data.atomic_output import leftovers
from gp_ground_seg.frame import Label
from gp_ground_seg.result import Segmentation


@dataclass
class SegmentationTally:
    """Counts over the frames of a run."""

    n_frames: int = 0
    n_points: int = 0
    n_ground: int = 0
    seconds: list[float] = field(default_factory=list)

    def add(self, result: Segmentation) -> None:
        """Count one frame."""
        self.n_frames += 1
        self.n_points += len(result.label)
        self.n_ground += int(np.count_nonzero(result.label == Label.GROUND))
        self.seconds.append(result.timings['total'])

    def summary(self, written_to: Path) -> str:
        """One line on the run."""
        share = f'{self.n_ground / self.n_points:.1%} ground' if self.n_points else 'no ground'
        return (
            f'{count(self.n_frames, "frame")}, {count(self.n_points, "point")}, {share}, '
            f'{1e3 * statistics.median(self.seconds):.1f} ms per frame (median, segmentation '
            f'only), written to {written_to}'
        )


def count(number: int, noun: str) -> str:
    """As in ``1 frame``, ``2 frames``."""
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def progress_bar(total: int, *, quiet: bool, title: str) -> tqdm[Any]:
    """Progress over frames on standard error; nothing where that is no terminal."""
    return tqdm(
        total=total,
        desc=title,
        unit='frame',
        file=sys.stderr,
        disable=True if quiet else None,
        leave=False,
    )


def note_leftovers(target: Path) -> None:
    """Point to unfinished output that earlier runs left beside `target`."""
    for path in leftovers(target):
        note(f'{path} is the unfinished output of another run; delete it if that one was killed')
