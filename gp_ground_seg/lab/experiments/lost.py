"""Objects of simulated scans that are called ground, by scene, sensor and range."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

from gp_ground_seg.lab.scoring.evaluate import MethodScore
from gp_ground_seg.lab.scoring.objects import MIN_HEIGHT, MIN_RETURNS, ObjectCount
from gp_ground_seg.lab.scoring.report import Column, Row, Table, percent
from gp_ground_seg.lab.simulation import PLACES

SCENES = (*PLACES, 'urban')
"""Scenes where objects hide the ground."""
BANDS = {'0-10 m': slice(0, 1), '10-20 m': slice(1, 2), '> 20 m': slice(2, None)}
"""Bands of range of the columns, as parts of `scoring.objects.BAND_TITLES`."""

COUNTED = {'vehicles': ('vehicle',), 'persons': ('person', 'cyclist')}
"""Classes of `scoring.objects.CLASSES` by column."""


def lost_tables(scores: Sequence[MethodScore], refused: Sequence[str] = ()) -> dict[str, Table]:
    """Objects lost, and returns on vehicles by range; ours, then the peer if there is one."""
    objects: list[Row] = []
    returns: list[Row] = []
    behind: list[str] = []
    more: list[str] = []
    lost: list[str] = []
    for group in scores[0].sequences:
        own = [score.of(group) for score in scores]
        names: Row = list(zip((Column('sensor'), Column('scene')), group.split(), strict=True))
        row = [*names, *_of_each(percent('IoU', 'iou'), [score.iou for score in own])]
        if own[0].iou < own[-1].iou:
            behind.append(group)
        for title, classes in COUNTED.items():
            bands = [[one.objects.get(name, ()) for name in classes] for one in own]
            counts = [sum(itertools.chain(*found), ObjectCount()) for found in bands]
            row.append((Column(title, '_d'), counts[0].n_objects))
            row += _of_each(Column('lost', '_d', f'lost_{title}'), [c.n_lost for c in counts])
            if counts[0].n_lost:
                lost.append(f'{group} {counts[0].n_lost} of {counts[0].n_objects} {title}')
        objects.append(row)
        row = names
        for title, band in BANDS.items():
            counts = [sum(one.objects.get('vehicle', ())[band], ObjectCount()) for one in own]
            shares = [count.share_ground for count in counts]
            row = [*row, *_of_each(percent(title), shares)]
            if shares[0] > shares[-1]:
                more.append(f'{group} {title}')
        returns.append(row)
    above = f'from {MIN_HEIGHT:g} m above the exact ground'
    of_objects = (
        'IoU of the ground against exact labels [%]; vehicles, persons and cyclists with at least '
        f'{MIN_RETURNS} returns {above}, and how many are lost: more than half of these returns '
        'called ground'
    )
    of_returns = f'Share of the returns on vehicles {above} that is called ground, by range [%]'
    objects_notes = [*refused, f'objects lost: {", ".join(lost) or "none"}']
    returns_notes = []
    if len(scores) > 1:
        of_objects += (
            f'; its: of {scores[1].title}, which has the true height and place of the sensor'
        )
        objects_notes.append(f'IoU behind {scores[1].title}: {", ".join(behind) or "nowhere"}')
        returns_notes = [f'more than {scores[1].title}: {", ".join(more) or "nowhere"}']
    return {
        'objects': Table.of(objects, title=of_objects, notes=objects_notes),
        'vehicles': Table.of(returns, title=of_returns, notes=returns_notes),
    }


def _of_each(column: Column, values: Sequence[float | int]) -> Row:
    """Cells of ours and of the peer, if there is one."""
    ours = replace(column, key=column.key or column.title)
    columns = ours, replace(ours, title='its', key=f'peer_{ours.key}')
    return list(zip(columns[: len(values)], values, strict=True))
