"""The reliability of probabilities as a table for the terminal."""

from __future__ import annotations

from gp_ground_seg.cli.tables import format_table, percent
from gp_ground_seg.evaluation.calibration import N_BINS, THRESHOLDS, Calibration
from gp_ground_seg.evaluation.conventions import GROUNDGRID
from gp_ground_seg.evaluation.scores import MethodScore


def calibration_table(score: MethodScore, pooled_name: str) -> str | None:
    """Lay out errors of the probabilities by sequence and pooled; None if there are none."""
    rows = []
    for sequence in (*score.sequences, None):
        found = score.calibration(sequence)
        if found is None:
            return None
        labels = score.pooled(GROUNDGRID.key, sequence)
        rows.append([sequence or pooled_name, *_cells(found, labels.iou)])
    header = ['sequence', 'points', 'ECE', 'Brier', 'IoU of labels', 'best IoU', 'at p_ground']
    table = format_table(header, rows, rule_before=len(rows) - 1)
    return (
        f'Probabilities (GroundGrid convention): expected calibration error over {N_BINS} bins, '
        f'Brier score;\nIoU [%] of the labels, and if ground were all points from the best '
        f'threshold on\n{table}'
    )


def _cells(found: Calibration, iou_of_labels: float) -> list[str]:
    if not found.n_total:
        return ['0', '-', '-', percent(iou_of_labels), '-', '-']
    step = found.best_step
    return [
        f'{found.n_total:,}'.replace(',', ' '),
        f'{found.ece:.4f}',
        f'{found.brier:.4f}',
        percent(iou_of_labels),
        percent(found.confusion_at(step).iou),
        f'{THRESHOLDS[step]:.3f}',
    ]
