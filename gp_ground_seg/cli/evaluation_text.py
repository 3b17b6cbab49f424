"""An evaluation as text for the terminal, at most 100 columns wide."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

from gp_ground_seg.cli.tables import format_table, milliseconds, percent
from gp_ground_seg.evaluation.conventions import CONVENTIONS, GROUNDGRID, Convention
from gp_ground_seg.evaluation.methods import PATCHWORKPP
from gp_ground_seg.evaluation.scores import RATIOS, MethodScore
from gp_ground_seg.evaluation.semantic_classes import class_name
from gp_ground_seg.labels import Label

WIDTH = 100
POOLED = 'all'
RATIO_TITLES = {
    'precision': 'precision',
    'recall': 'recall',
    'f1': 'F1',
    'accuracy': 'accuracy',
    'iou': 'IoU',
}
PEER_TITLES = {PATCHWORKPP: 'Patchwork++'}
TRUTH_TITLES = {
    Label.GROUND: 'ground',
    Label.OBSTACLE: 'obstacle',
    Label.UNKNOWN: 'left out',
}


def evaluation_text(scores: Sequence[MethodScore], document: dict[str, Any]) -> str:
    """Lay out headline, tables and what was run.

    Parameters
    ----------
    scores : sequence of MethodScore
        Ours first, then peers.
    document : dict
        Their report (see `gp_ground_seg.evaluation.report`).
    """
    parts = [_headline(scores)]
    parts += [_convention_table(scores, convention) for convention in CONVENTIONS]
    parts += [_class_table(scores[0]), _time_table(scores), _footer(document)]
    return '\n\n'.join(parts)


def _title(score: MethodScore) -> str:
    return PEER_TITLES.get(score.name, score.name)


def _count(number: int, noun: str) -> str:
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def _headline(scores: Sequence[MethodScore]) -> str:
    ours, *peers = scores
    frames, sequences = len(ours.frames), len(ours.sequences)
    iou = f'IoU {percent(ours.pooled(GROUNDGRID.key).iou)} %'
    time = f'{milliseconds(ours.median_seconds)} ms per frame'
    for peer in peers:
        iou += f', {_title(peer)} {percent(peer.pooled(GROUNDGRID.key).iou)} %'
        time += f', {_title(peer)} {milliseconds(peer.median_seconds)} ms'
    pooled = f'{_count(frames, "frame")} of {_count(sequences, "sequence")}'
    return f'{iou}  (GroundGrid convention, {pooled})\n{time}  (median)'


def _convention_table(scores: Sequence[MethodScore], convention: Convention) -> str:
    ours, *peers = scores
    header = ['sequence', 'frames', *(RATIO_TITLES[name] for name in RATIOS)]
    for peer in peers:
        header += [f'{_title(peer)} IoU', 'difference']
    rows = []
    for sequence in (*ours.sequences, None):
        confusion = ours.pooled(convention.key, sequence)
        n_frames = sum(1 for f in ours.frames if sequence in (None, f.sequence))
        row = [sequence or POOLED, str(n_frames)]
        row += [percent(getattr(confusion, name)) for name in RATIOS]
        for peer in peers:
            iou = peer.pooled(convention.key, sequence).iou
            row += [percent(iou), percent(confusion.iou - iou, sign=True)]
        rows.append(row)
    table = format_table(header, rows, rule_before=len(rows) - 1)
    return f'{convention.title} convention: {convention.rule}  [%]\n{table}'


def _class_table(score: MethodScore) -> str:
    """Classes by what they count as, and in that by how much they cost."""
    errors = score.pooled(GROUNDGRID.key).errors
    rows = []
    for number, count in score.classes().items():
        truth = GROUNDGRID.truth_of_class(number)
        wrong = {
            Label.GROUND: count.points - count.labelled_ground,
            Label.OBSTACLE: count.labelled_ground,
            Label.UNKNOWN: 0,
        }[truth]
        cells = [
            class_name(number),
            TRUTH_TITLES[truth],
            f'{count.points:,}'.replace(',', ' '),
            percent(count.share_ground),
            '-' if truth is Label.UNKNOWN or not errors else percent(wrong / errors),
        ]
        rows.append((list(TRUTH_TITLES).index(truth), -wrong, -count.points, cells))
    table = format_table(
        ['class', 'counts as', 'points', 'labelled ground [%]', 'of all errors [%]'],
        [cells for *_, cells in sorted(rows)],
        n_left=2,
    )
    return f'Classes (GroundGrid convention)\n{table}'


def _time_table(scores: Sequence[MethodScore]) -> str:
    ours = scores[0]
    rows = []
    for score in scores:
        row = [_title(score), milliseconds(score.median_seconds), milliseconds(score.mean_seconds)]
        if len(scores) > 1:
            row.append(f'{ours.median_seconds / score.median_seconds:.2f}')
        rows.append(row)
    header = ['method', 'median', 'mean', 'ours / this'][: len(rows[0])]
    stages = ', '.join(
        f'{stage} {milliseconds(seconds)}'
        for stage, seconds in ours.median_stage_seconds().items()
    )
    table = format_table(header, rows)
    return f'Time per frame, reading left out  [ms]\n{table}\n{_wrapped(f"stages: {stages}")}'


def _footer(document: dict[str, Any]) -> str:
    environment = document['environment']
    versions = ', '.join(
        f'{name} {version or "absent"}' for name, version in environment['versions'].items()
    )
    changes = ', '.join(f'{name}={value}' for name, value in document['config_changes'].items())
    machine = (
        f'{environment["cpu"]}, {_count(document["n_threads"], "thread")} on '
        f'{_count(environment["n_cores"], "core")}, {document["backend"]}'
    )
    return '\n'.join(
        _wrapped(line)
        for line in (
            f'parameters: {changes or "defaults"}',
            f'machine: {machine}',
            f'versions: Python {environment["python"]}, {versions}',
        )
    )


def _wrapped(line: str) -> str:
    return textwrap.fill(line, WIDTH, subsequent_indent='  ', break_on_hyphens=False)
