"""Table and plain data of a leave-one-sequence-out search."""

from __future__ import annotations

from typing import Any

from gp_ground_seg.cli.output import count
from gp_ground_seg.cli.tables import percent
from gp_ground_seg.experiments.leave_out import Choice, LeaveOut, SequenceScore, pool

Table = tuple[list[str], list[list[str]]]
"""Header and rows."""


def leave_out_title(result: LeaveOut) -> str:
    """One line on what is in the table."""
    n_sequences = count(len(result.folds), 'sequence')
    return (
        'IoU [%] and expected calibration error, GroundGrid convention: as given; with the values '
        f'best on all {n_sequences} (tuned); each sequence with the values best on the others '
        f'(left out). {count(result.n_configurations, "configuration")} scored.'
    )


def leave_out_table(result: LeaveOut) -> Table:
    """Table by sequence, pooled in the last row."""
    header = ['sequence', 'given', 'tuned', 'left out', 'ECE given', 'ECE tuned', 'ECE left out']
    rows = [
        [
            fold.left_out,
            *_cells(result.base[fold.left_out], result.tuned[fold.left_out], fold.score),
        ]
        for fold in result.folds
    ]
    pooled = (pool(result.base.values()), pool(result.tuned.values()), result.left_out)
    return header, [*rows, ['all', *_cells(*pooled)]]


def _cells(*scores: SequenceScore) -> list[str]:
    return [percent(one.confusion.iou) for one in scores] + [
        f'{one.calibration.ece:.4f}' for one in scores
    ]


def choice_table(result: LeaveOut) -> Table:
    """Table of the values: a row for each parameter, a column for each search.

    The search without sequence 00 is titled ``- 00``.
    """
    choices = {
        'given': result.start,
        'tuned': result.tuned_choice,
        **{f'- {fold.left_out}': fold.choice for fold in result.folds},
    }
    rows = [
        [name, *(_value(choice[name]) for choice in choices.values())] for name in result.start
    ]
    return ['parameter', *choices], rows


def _value(value: Any) -> str:
    return f'{value:g}' if isinstance(value, float) else str(value).lower()


def leave_out_data(result: LeaveOut) -> dict[str, Any]:
    """Every number, in JSON's own types."""
    return {
        'n_configurations': result.n_configurations,
        'given': _search(result.start, result.base),
        'tuned': _search(result.tuned_choice, result.tuned),
        'left_out': {
            'pooled': _numbers(result.left_out),
            'folds': {
                fold.left_out: {'choice': fold.choice, **_numbers(fold.score)}
                for fold in result.folds
            },
        },
    }


def _search(choice: Choice, scores: dict[str, SequenceScore]) -> dict[str, Any]:
    return {
        'choice': choice,
        'pooled': _numbers(pool(scores.values())),
        'sequences': {name: _numbers(one) for name, one in scores.items()},
    }


def _numbers(one: SequenceScore) -> dict[str, Any]:
    confusion = one.confusion
    counts = {name: getattr(confusion, name) for name in ('tp', 'fp', 'fn', 'tn')}
    ratios = {
        'iou': confusion.iou,
        'ece': one.calibration.ece,
        'brier': one.calibration.brier,
    }
    return counts | {name: None if v != v else v for name, v in ratios.items()}
