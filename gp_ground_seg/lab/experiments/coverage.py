"""Whether the ground lies within its standard deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.experiments.variants import SimulatedFrame, score_variants
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.evaluate import ALL, OURS, RingScore
from gp_ground_seg.lab.scoring.metrics import RING_TITLES, TRIMMED
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, centimetres, percent
from gp_ground_seg.lab.scoring.tables import make_report


def score_coverage(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Compare errors of the ground's height with their standard deviations.

    How many lie within one and two, by sequence and range. On labelled frames the returns are
    compared (return_std), on simulated scans the ground itself (ground_std), by exact heights.
    """
    (score,) = score_variants(items, {OURS: config}, runner=runner)
    is_simulated = isinstance(items[0], SimulatedFrame)
    names = ('sensor', 'scene') if is_simulated else ('sequence',)
    groups: dict[str, dict[str, RingScore]] = {name: {} for name in names}
    for scan in score.scans:
        words = scan.sequence.split(maxsplit=len(names) - 1)
        for parts, word in zip(groups.values(), words, strict=True):
            parts[word] = sum(scan.rings, parts.get(word, RingScore()))
    groups['range'] = dict(zip(RING_TITLES, score.rings, strict=True))
    what = 'ground_std against exact heights under ground returns'
    if not is_simulated:
        what = 'return_std against labelled ground returns'
    tables = {name: _table(name, parts, what) for name, parts in groups.items()}
    return make_report(tables, [score], config)


def _table(name: str, parts: Mapping[str, RingScore], what: str) -> Table:
    """Table of groups of scans or rings, and of all."""
    rows: list[Row] = []
    for group, part in {**parts, ALL: sum(parts.values(), RingScore())}.items():
        height = part.height
        rows.append(
            [
                (Column(name), group),
                (Column('points', '_d'), height.n_points),
                (percent('1 std', 'within_1', '.1f'), height.within_1),
                (percent('2 std', 'within_2', '.1f'), height.within_2),
                (Column('NLPD', '.2f', 'nlpd'), height.nlpd),
                (centimetres('bias'), height.bias),
                (centimetres('RMSE', 'rmse'), height.rmse),
                (Column('ECE', '.4f', 'ece'), part.calibration.ece),
            ]
        )
    title = (
        f'ground_z and {what}, by {name}: points within 1 and 2 standard deviations [%] (68.3 and '
        '95.4 of a normal distribution), mean negative log predictive density without the '
        f'worst {TRIMMED:.1%} of each frame, bias and RMSE [cm]; expected calibration error of '
        'p_ground'
    )
    return Table(rows, title, n_sums=1)
