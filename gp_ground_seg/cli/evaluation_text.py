"""An evaluation as text for the terminal, at most 100 columns wide."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

from gp_ground_seg.cli.calibration_text import calibration_table
from gp_ground_seg.cli.tables import format_table, milliseconds, percent
from gp_ground_seg.evaluation.class_errors import class_errors
from gp_ground_seg.evaluation.conventions import CONVENTIONS, GROUNDGRID, Convention
from gp_ground_seg.evaluation.methods import PATCHWORKPP
from gp_ground_seg.evaluation.rings import ring_titles
from gp_ground_seg.evaluation.scores import RATIOS, MethodScore
from gp_ground_seg.evaluation.semantic_classes import class_name
from gp_ground_seg.frame import Label

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
    parts += [_ring_table(scores), _class_table(scores[0])]
    if (probabilities := calibration_table(scores[0], POOLED)) is not None:
        parts.append(probabilities)
    parts += [_time_table(scores), _footer(document)]
    return '\n\n'.join(parts)


def _title(score: MethodScore) -> str:
    return PEER_TITLES.get(score.name, score.name)


def _count(number: int, noun: str) -> str:
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def _thousands(number: int) -> str:
    return f'{number:,}'.replace(',', ' ')


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


def _ring_table(scores: Sequence[MethodScore]) -> str:
    """Where over range the score is lost."""
    ours, *peers = scores
    header = ['range', 'points', 'errors', 'of errors', 'precision', 'recall', 'IoU']
    for peer in peers:
        header += [f'{_title(peer)} IoU', 'difference']
    errors = ours.pooled(GROUNDGRID.key).errors
    rows = []
    for title, ring, *theirs in zip(ring_titles(), *(s.rings() for s in scores), strict=False):
        row = [title, _thousands(ring.points), _thousands(ring.errors)]
        row.append(percent(ring.errors / errors if errors else math.nan))
        row += [percent(ring.precision), percent(ring.recall), percent(ring.iou)]
        for its in theirs:
            row += [percent(its.iou), percent(ring.iou - its.iou, sign=True)]
        rows.append(row)
    return f'Horizontal range (GroundGrid convention)  [%]\n{format_table(header, rows)}'


def _class_table(score: MethodScore) -> str:
    """Classes by what they count as, and in that by how much they cost."""
    found = class_errors(score.classes())
    errors = score.pooled(GROUNDGRID.key).errors
    n_points = sum(one.points for one in found)
    rows = [
        [
            class_name(one.number),
            TRUTH_TITLES[one.truth],
            _thousands(one.points),
            percent(one.points / n_points),
            percent(one.labelled_ground / one.points),
            percent(one.missed / one.points) if one.truth is Label.GROUND else '-',
            percent(one.false / one.points) if one.truth is Label.OBSTACLE else '-',
            '-' if one.truth is Label.UNKNOWN or not errors else percent(one.errors / errors),
        ]
        for one in sorted(found, key=lambda one: list(TRUTH_TITLES).index(one.truth))
    ]
    header = ['class', 'counts as', 'points', 'of points', 'as ground', 'missed', 'false']
    table = format_table([*header, 'of errors'], rows, n_left=2)
    return (
        'Classes (GroundGrid convention): share of all points; of the class, what was labelled '
        'ground,\nwhat is missed ground and what is false ground; share of all errors  [%]\n'
        f'{table}'
    )


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
