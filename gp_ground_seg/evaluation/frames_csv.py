"""One line per frame, for spreadsheets and plots."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from gp_ground_seg.evaluation.class_errors import class_errors
from gp_ground_seg.evaluation.conventions import CONVENTIONS
from gp_ground_seg.evaluation.scores import RATIOS, FrameScore, MethodScore
from gp_ground_seg.evaluation.semantic_classes import class_name


def write_frames_csv(scores: Sequence[MethodScore], path: str | Path) -> None:
    """Write the frames of each method, one line each; ratios in [0, 1], empty if undefined.

    Parameters
    ----------
    scores : sequence of MethodScore
        Methods; what only some of them tell of a frame is empty for the others.
    path : str or Path
        File to write.
    """
    rows = [_row(score.name, frame) for score in scores for frame in score.frames]
    columns = dict.fromkeys(name for row in rows for name in row)
    with Path(path).open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, list(columns), restval='', lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)


def _row(method: str, frame: FrameScore) -> dict[str, str | int]:
    row: dict[str, str | int] = {
        'method': method,
        'sequence': frame.sequence,
        'frame': frame.index,
        'points': sum(count.points for count in frame.classes.values()),
    }
    for convention in CONVENTIONS:
        confusion = frame.confusions[convention.key]
        row.update({f'{convention.key}_{k}': v for k, v in dataclasses.asdict(confusion).items()})
        row.update(
            {f'{convention.key}_{name}': _number(getattr(confusion, name)) for name in RATIOS}
        )
    worst = next(iter(class_errors(frame.classes)), None)
    row['main_error_class'] = class_name(worst.number) if worst and worst.errors else ''
    row['ms'] = f'{1e3 * frame.seconds:.3f}'
    for name, fact in frame.facts.items():
        row[name] = fact if isinstance(fact, str) else _number(fact)
    return row


def _number(value: float) -> str:
    return '' if math.isnan(value) else f'{value:.6g}'
