"""Two methods on the same scans: differences with their intervals, scans that differ most."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from gp_ground_seg.evaluation.evaluate import ALL, KnownScan, MethodScore, OurMethod
from gp_ground_seg.evaluation.intervals import (
    INTERVAL,
    Interval,
    Sums,
    clusters,
    difference_interval,
    interval_note,
    iou_sums,
    mse_sums,
)
from gp_ground_seg.evaluation.metrics import Labels, ratio
from gp_ground_seg.evaluation.objects import ObjectCount
from gp_ground_seg.evaluation.report import (
    Cell,
    Column,
    Table,
    centimetres,
    milliseconds,
    percent,
)
from gp_ground_seg.frame import Label


def _objects(score: MethodScore) -> ObjectCount:
    return sum(itertools.chain(*score.objects.values()), ObjectCount())


MEASURES: tuple[tuple[Column, Sums], ...] = (
    (percent('IoU [%]', 'iou'), iou_sums),
    (percent('precision [%]', 'precision'),
     lambda s: (s.confusion.tp, s.confusion.tp + s.confusion.fp)),
    (percent('recall [%]', 'recall'), lambda s: (s.confusion.tp, s.confusion.tp + s.confusion.fn)),
    (percent('returns on objects called ground [%]', 'share_ground'),
     lambda s: (_objects(s).n_ground, _objects(s).n_returns)),
    (percent('objects lost [%]', 'share_lost'),
     lambda s: (_objects(s).n_lost, _objects(s).n_objects)),
    (centimetres('RMSE of the height [cm]', 'rmse'), mse_sums),
    (percent('heights within 1 std, ideally 68.3 [%]', 'within_1'),
     lambda s: (s.height.n_within_1, s.height.n_with_std)),
    (percent('heights within 2 std, ideally 95.4 [%]', 'within_2'),
     lambda s: (s.height.n_within_2, s.height.n_with_std)),
    (milliseconds('time per frame, mean [ms]', 'seconds'),
     lambda s: (sum(scan.seconds for scan in s.scans), len(s.scans))),
)  # fmt: skip
"""What is compared, as it is shown, and as a ratio of sums over scans."""


class Difference(NamedTuple):
    """A measure of two methods, and the interval of the second minus the first."""

    column: Column
    first: float
    second: float
    interval: Interval | None

    def row(self) -> list[Cell]:
        """Cells of a table: the measures have units of their own."""
        show, signed = self.column.show, replace(self.column, format=f'+{self.column.format}').show
        words = None
        if self.interval is not None:
            words = ' to '.join(map(signed, self.interval)) + ' tie' * self.interval.is_tie
        change = signed(self.second - self.first)
        return [self.column.title, show(self.first), show(self.second), change, words]

    def json(self) -> dict[str, Any]:
        """Return all numbers, unscaled."""
        low, high = self.interval or (math.nan, math.nan)
        numbers = {'first': self.first, 'second': self.second, 'low': low, 'high': high}
        return {'measure': self.column.key, **numbers, 'difference': self.second - self.first}


def find_differences(first: MethodScore, second: MethodScore) -> list[Difference]:
    """Compare two methods by each of `MEASURES` that the scans tell."""
    parts = clusters(first), clusters(second)
    found = []
    for column, sums in MEASURES:
        values = [ratio(*sums(score)) for score in (first, second)]
        if sums is mse_sums:
            values = [math.sqrt(value) for value in values]
        if not math.isnan(values[0]):
            found.append(Difference(column, *values, difference_interval(*parts[::-1], sums)))
    return found


def difference_table(
    differences: Sequence[Difference], first: MethodScore, names: Sequence[str], title: str = ''
) -> Table:
    """Lay out `find_differences`; `names` are those of the methods, `first` is one's score."""
    n_parts, n_sequences = len(clusters(first)), len(first.sequences)
    drawn = f'{n_parts} sequences' if n_sequences > 1 else f'{n_parts} blocks of successive frames'
    columns = [Column('measure'), *(Column(name, 's') for name in (*names, 'difference'))]
    title = f'{title}difference: {names[1]} minus {names[0]}; {interval_note(drawn)}'
    notes = []
    if n_parts < 2:
        notes = ['no intervals: they need two sequences, or ten frames of one']
    return Table([*columns, INTERVAL], [one.row() for one in differences], title, notes)


class Disagreement(NamedTuple):
    """How many points of a scan have two labels."""

    sequence: str
    index: str
    n_points: int
    n_different: int
    n_first: int  # called ground by the first method only
    n_second: int

    @property
    def share(self) -> float:
        """Share of the points whose labels differ."""
        return ratio(self.n_different, self.n_points)


class DisagreementWatch:
    """Counts points that two methods label differently; keeps the scans with most of them."""

    def __init__(self, first: OurMethod, second: OurMethod, n_kept: int) -> None:
        self._methods, self._n_kept = (first, second), n_kept
        self.scans: list[Disagreement] = []
        self.kept: list[tuple[Disagreement, KnownScan, tuple[Labels, Labels]]] = []

    def watch(self, scan: KnownScan) -> None:
        """Count in the scan that both have segmented."""
        one, other = labels = self._methods[0].last.label, self._methods[1].last.label
        only = [(a == Label.GROUND) & (b != Label.GROUND) for a, b in ((one, other), (other, one))]
        n_different, n_first, n_second = (int(own.sum()) for own in (one != other, *only))
        found = Disagreement(scan.sequence, scan.index, len(one), n_different, n_first, n_second)
        self.scans.append(found)
        self.kept.append((found, scan, labels))
        self.kept.sort(key=lambda kept: -kept[0].share)
        del self.kept[self._n_kept :]


def disagreement_table(scans: Sequence[Disagreement], names: Sequence[str]) -> Table:
    """Lay out by sequence how many points two methods label differently."""
    groups: dict[str, list[Disagreement]] = {}
    for scan in scans:
        groups.setdefault(scan.sequence, []).append(scan)
    rows: list[list[Cell]] = []
    for name, own in {**groups, ALL: list(scans)}.items():
        n_points, *counts = (sum(column) for column in zip(*(scan[2:] for scan in own)))
        rows.append([name, len(own), n_points, *(ratio(count, n_points) for count in counts)])
    columns = [Column('sequence'), Column('frames', 'd'), Column('points', '_d')]
    columns += [percent('differ', 'share_different')]
    columns += [
        percent(f'ground in {name} only', f'share_{k}_only') for k, name in enumerate(names, 1)
    ]
    return Table(columns, rows, 'Points with two labels  [% of all points]', n_sums=1)
