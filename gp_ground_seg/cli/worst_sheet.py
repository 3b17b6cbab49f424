"""The sheet of the worst frames of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gp_ground_seg.cli.tables import percent
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.class_errors import class_errors
from gp_ground_seg.evaluation.conventions import GROUNDGRID
from gp_ground_seg.evaluation.scores import FrameScore
from gp_ground_seg.evaluation.semantic_classes import class_name
from gp_ground_seg.evaluation.worst import LabelledFrame
from gp_ground_seg.plotting.birds_eye import SheetPanel, plot_error_sheet

LEAST_SHARE = 0.01
"""Classes with less of a frame's errors are not named."""


def write_worst_sheet(worst: Sequence[LabelledFrame], n_frames: int, path: str | Path) -> None:
    """Draw frames with their errors.

    Parameters
    ----------
    worst : sequence of LabelledFrame
        What to draw.
    n_frames : int
        Out of how many.
    path : str or Path
        PNG to write.

    Raises
    ------
    DataError
        If there is nothing to draw.
    """
    if not worst:
        raise DataError(f'no sheet of worst frames: nothing to score in {n_frames} frames')
    panels = [_panel(one) for one in worst]
    title = f'Worst {len(worst)} of {n_frames} frames, GroundGrid convention; x up, y left [m]'
    plot_error_sheet(panels, path, title)


def _panel(one: LabelledFrame) -> SheetPanel:
    points = read_points(one.frame.points_path)
    assert one.frame.labels_path is not None, 'it was scored'
    truth = GROUNDGRID.truth(read_labels(one.frame.labels_path, len(points)), points[:, 2])
    title = f'{one.frame.sequence} / {one.frame.index}    IoU {percent(one.iou)} %'
    return SheetPanel(title, _main_errors(one.score), points, one.label, truth)


def _main_errors(score: FrameScore) -> str:
    """Name the classes that cost most, as in ``missed terrain 68 %, false building 16 %``."""
    confusion = score.confusions[GROUNDGRID.key]
    parts = [
        f'{"missed" if one.missed else "false"} {class_name(one.number)} '
        f'{one.errors / confusion.errors:.0%}'
        for one in class_errors(score.classes)[:3]
        if one.errors > LEAST_SHARE * confusion.errors
    ]
    if not confusion.errors:
        return 'no errors'
    return f'{confusion.fp} false, {confusion.fn} missed: {", ".join(parts)}'
