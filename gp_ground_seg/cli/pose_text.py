"""Trials of the estimated pose as tables: titles, headers and rows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gp_ground_seg.cli.experiment_text import markdown_table, wrapped
from gp_ground_seg.cli.tables import format_table, percent
from gp_ground_seg.experiments.pose_trials import (
    FOUND,
    LEVEL,
    TILT,
    TOLD,
    AxisTrial,
    PoseTrial,
    pooled,
)

UNTURNED = (0, 0)


@dataclass(frozen=True)
class Table:
    """A titled table."""

    title: str
    header: list[str]
    rows: list[list[str]]

    @property
    def text(self) -> str:
        """As aligned text."""
        return f'{wrapped(self.title)}\n{format_table(self.header, self.rows)}'

    @property
    def markdown(self) -> str:
        """As Markdown."""
        return f'{self.title}\n\n{markdown_table(self.header, self.rows)}'


def pose_tables(trials: Sequence[PoseTrial], axes: Sequence[AxisTrial]) -> list[Table]:
    """All tables of one kind of data."""
    groups = list(dict.fromkeys(trial.group for trial in trials))
    turns = list(dict.fromkeys(trial.turn for trial in trials))
    found_turned = [turn for turn in turns if turn != UNTURNED]
    return [
        _height_table(trials, groups),
        *([_turn_table(trials, groups, found_turned)] if found_turned else []),
        _axis_table(axes),
    ]


def _height_table(trials: Sequence[PoseTrial], groups: Sequence[str]) -> Table:
    own = [trial for trial in trials if trial.turn == UNTURNED]
    rows = []
    for group in (*groups, None):
        chosen = [trial for trial in own if group in (None, trial.group)]
        if not chosen or (group is None and len(groups) == 1):
            continue
        errors = [t.found.height - t.height for t in chosen if t.found is not None]
        leans = [_lean(t) for t in chosen]
        n_levelled = sum(t.found is not None and not t.found.is_level for t in chosen)
        n_guessed = sum(t.found is None or not t.found.height_estimated for t in chosen)
        told, found = (pooled(chosen, way).iou for way in (TOLD, FOUND))
        rows.append(
            [
                group or 'all',
                str(len(chosen)),
                percent(told),
                percent(found),
                percent(found - told, sign=True),
                f'{_worst_drop(chosen):+.2f}',
                f'{min(errors):+.2f}' if errors else '-',
                f'{max(errors):+.2f}' if errors else '-',
                f'{max(leans):.1f}',
                str(n_levelled),
                str(n_guessed),
            ]
        )
    return Table(
        'Scans as they are: ground IoU in percent with the pose told and found out (auto); the '
        'worst change of a sequence or height; lowest and highest error of the height [m]; the '
        'largest tilt measured [degrees]; how many were levelled, and how many did not tell '
        'their height',
        ['', 'scans', 'told', 'auto', 'change', 'worst', 'low', 'high', 'tilt', 'levelled',
         'silent'],
        rows,
    )  # fmt: skip


def _worst_drop(trials: Iterable[PoseTrial]) -> float:
    """Largest loss [percent] over the heights of each group."""
    parts: dict[tuple[str, float], list[PoseTrial]] = {}
    for trial in trials:
        parts.setdefault((trial.group, trial.height), []).append(trial)
    return 100.0 * min(pooled(p, FOUND).iou - pooled(p, TOLD).iou for p in parts.values())


def _lean(trial: PoseTrial) -> float:
    """Tilt that the scan shows [degrees]."""
    if trial.found is None or trial.found.measured is None:
        return 0.0
    measured = trial.found.measured
    return math.degrees(math.acos(math.cos(measured.roll) * math.cos(measured.pitch)))


def _turn_table(
    trials: Sequence[PoseTrial], groups: Sequence[str], turns: Sequence[tuple[int, int]]
) -> Table:
    """Pooled over the groups by turn where there are many turns, by group where there is one."""
    by_turn = len(turns) > 1
    rows = []
    for key in (*(turns if by_turn else groups), None):
        chosen = [
            t
            for t in trials
            if t.turn in turns and (key is None or key == (t.turn if by_turn else t.group))
        ]
        told, level, found = (pooled(chosen, way).iou for way in (TOLD, LEVEL, FOUND))
        parts = {t.group for t in chosen}
        worst = min(
            pooled((t for t in chosen if t.group == group), FOUND).iou
            - pooled((t for t in chosen if t.group == group), TOLD).iou
            for group in parts
        )
        n_levelled = sum(t.found is not None and not t.found.is_level for t in chosen)
        rows.append(
            [
                'all' if key is None else _turn_text(key) if isinstance(key, tuple) else key,
                str(len(chosen)),
                percent(told),
                percent(level),
                percent(level - told, sign=True),
                percent(found),
                percent(found - told, sign=True),
                percent(worst, sign=True),
                str(n_levelled),
            ]
        )
    what = '' if by_turn else f' by {_turn_text(turns[0])}'
    return Table(
        f'Scans turned{what}: ground IoU in percent with the turn told; with only the height '
        'told, taken to be level; and with all found out (auto). Each with its change against '
        'told, the worst one that of a group; how many scans were levelled',
        ['turned by' if by_turn else '', 'scans', 'told', 'level', 'change', 'auto', 'change',
         'worst', 'levelled'],
        rows,
    )  # fmt: skip


def _turn_text(turn: tuple[int, int]) -> str:
    degrees = math.degrees(TILT)
    parts = [
        f'{name} {steps * degrees:+.0f}°'
        for name, steps in zip(('roll', 'pitch'), turn, strict=True)
        if steps
    ]
    return ' '.join(parts)


def _axis_table(axes: Sequence[AxisTrial]) -> Table:
    rows = []
    for up in dict.fromkeys(trial.up for trial in axes):
        own = [trial for trial in axes if trial.up == up]
        n_scans = sum(trial.n_scans for trial in own)
        n_refused = sum(trial.n_refused for trial in own)
        rows.append([up, str(n_scans), str(n_refused)])
    return Table(
        'Scans turned over: refused because z is not up',
        ['up', 'scans', 'refused'],
        rows,
    )
