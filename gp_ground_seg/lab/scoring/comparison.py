"""Two methods on the same scans: the difference of each measure, with its interval."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from gp_ground_seg.lab.scoring import intervals, report
from gp_ground_seg.lab.scoring.evaluate import MethodScore
from gp_ground_seg.lab.scoring.metrics import ratio
from gp_ground_seg.lab.scoring.objects import ObjectCount
from gp_ground_seg.lab.scoring.report import Column, Table, percent


def _objects(score: MethodScore) -> ObjectCount:
    return sum(itertools.chain(*score.objects.values()), ObjectCount())


MEASURES: tuple[tuple[Column, intervals.Sums], ...] = (
    (percent('IoU [%]', 'iou'), intervals.iou_sums),
    (percent('precision [%]', 'precision'),
     lambda s: (s.confusion.tp, s.confusion.tp + s.confusion.fp)),
    (percent('recall [%]', 'recall'), lambda s: (s.confusion.tp, s.confusion.tp + s.confusion.fn)),
    (percent('returns on objects called ground [%]', 'share_ground'),
     lambda s: (_objects(s).n_ground, _objects(s).n_returns)),
    (percent('objects lost [%]', 'share_lost'),
     lambda s: (_objects(s).n_lost, _objects(s).n_objects)),
    (report.centimetres('RMSE of the height [cm]', 'rmse'), intervals.mse_sums),
    (percent('heights within 1 std, ideally 68.3 [%]', 'within_1'),
     lambda s: (s.height.n_within_1, s.height.n_with_std)),
    (percent('heights within 2 std, ideally 95.4 [%]', 'within_2'),
     lambda s: (s.height.n_within_2, s.height.n_with_std)),
    (report.milliseconds('time per frame, mean [ms]', 'seconds'),
     lambda s: (sum(scan.seconds for scan in s.scans), len(s.scans))),
)  # fmt: skip
"""What is compared, as it is shown, and as a ratio of sums over scans."""


class Difference(NamedTuple):
    """A measure of two methods, unscaled, and the interval of `difference`; NaN without one."""

    measure: str
    first: float
    second: float
    difference: float  # second minus first
    low: float
    high: float


def find_differences(first: MethodScore, second: MethodScore) -> list[Difference]:
    """Compare two methods by each of `MEASURES`; those without data in the scans are NaN."""
    found = []
    for column, sums in MEASURES:
        one, other = (ratio(*sums(score)) for score in (first, second))
        if sums is intervals.mse_sums:
            one, other = math.sqrt(one), math.sqrt(other)
        parts = intervals.clusters(second), intervals.clusters(first)
        ends = intervals.difference_interval(*parts, sums) or (math.nan, math.nan)
        found.append(Difference(column.key, one, other, other - one, *ends))
    return found


def difference_table(score: MethodScore, found: Sequence[Difference], names: list[str]) -> Table:
    """Lay out `find_differences` of methods with these names; `score` is that of one."""
    rows: list[list[report.Cell]] = []
    for (column, _), one in zip(MEASURES, found, strict=True):
        show, signed = column.show, replace(column, format=f'+{column.format}').show
        words = f'{signed(one.low)} to {signed(one.high)}' + ' tie' * (one.low <= 0 <= one.high)
        if not math.isnan(one.first):
            cells = [show(one.first), show(one.second), signed(one.difference)]
            rows.append([column.title, *cells, None if math.isnan(one.low) else words])
    n_parts = len(intervals.clusters(score))
    kind = 'sequences' if len(score.sequences) > 1 else 'blocks of successive frames'
    note = intervals.interval_note(f'{n_parts} {kind}')
    if n_parts < 2:
        note = 'no intervals: they need two sequences, or ten frames of one'
    title = f'difference: {names[1]} minus {names[0]}; {note}'
    columns = [Column('measure'), *(Column(name, 's') for name in [*names, 'difference'])]
    return Table([*columns, intervals.INTERVAL], rows, title)
