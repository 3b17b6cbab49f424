"""Table of the returns on objects, and of the objects, that methods call ground."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial

from gp_ground_seg.lab.scoring.evaluate import ALL, MethodScore
from gp_ground_seg.lab.scoring.intervals import INTERVAL, interval_note, interval_text
from gp_ground_seg.lab.scoring.objects import BAND_TITLES, MIN_HEIGHT, MIN_RETURNS, ObjectCount
from gp_ground_seg.lab.scoring.report import Cell, Column, Table, percent


def object_table(scores: Sequence[MethodScore], clusters: str) -> Table:
    """Lay out what of objects each method calls ground, by class and range; ours is the first.

    `clusters` says what `MethodScore.parts` are, as in ``6 sequences``.
    """
    bands = [*BAND_TITLES, ALL]
    counts = [
        {name: [*own, sum(own, ObjectCount())] for name, own in one.objects.items()}
        for one in scores
    ]
    rows: list[list[Cell]] = []
    for name, (k, band) in itertools.product(counts[0], enumerate(bands)):
        ours, *its = (found[name][k] for found in counts)
        row: list[Cell] = [name, band, ours.n_returns, ours.share_ground]
        row += [one.share_ground for one in its]
        sums = partial(_object_sums, name, k)
        row += [interval_text(scores[0].parts(), one.parts(), sums) for one in scores[1:]]
        row += [ours.n_objects, *(one.n_lost if one.n_objects else None for one in (ours, *its))]
        rows.append(row)
    columns = [Column('class'), Column('range'), Column('returns', '_d')]
    columns.append(percent('as ground', 'share_ground'))
    columns += [percent('its', f'{one.name}_share_ground') for one in scores[1:]]
    columns += [INTERVAL for _ in scores[1:]]
    columns += [Column('objects', '_d'), Column('lost', '_d')]
    columns += [Column('its lost', '_d', f'{one.name}_lost') for one in scores[1:]]
    title = (
        f'Objects: returns on them from {MIN_HEIGHT:g} m above the local ground, and the share '
        f'called ground [%]; objects with at least {MIN_RETURNS} such returns, and how many of '
        'them are lost: more than half of these returns called ground'
    )
    if len(scores) > 1:
        note = interval_note(clusters)
        title += f'; its: of {scores[1].title}; {note}'
    notes = []
    if not rows:
        notes = ['no return on an object: no class of objects in the labels']
    elif not any(found[name][-1].n_objects for found in counts for name in found):
        notes = ['no object with enough returns: only classes, if labels have no instances']
    if n_unknown := sum(own[-1].n_unknown for own in counts[0].values()):
        shown = Column('', '_d').show(n_unknown)
        notes.append(f'{shown} returns on objects do not count: no labels of the ground near them')
    return Table(columns, rows, title, notes)


def _object_sums(name: str, k: int, score: MethodScore) -> tuple[float, float]:
    """Return how many returns of a class in a band, at the end in all, are ground, and all."""
    bands = score.objects.get(name, ())
    found = sum(bands if k == len(BAND_TITLES) else bands[k : k + 1], ObjectCount())
    return found.n_ground, found.n_returns
