"""Simulated scenes beside Patchwork++: IoU and height, and objects that are called ground."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.experiments.variants import TOLD, SimulatedFrame, score_simulated
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.comparison import INTERVAL, counts_of_all, interval_text
from gp_ground_seg.lab.scoring.evaluate import ALL, MethodScore
from gp_ground_seg.lab.scoring.metrics import ratio
from gp_ground_seg.lab.scoring.objects import (
    LOW_CLASSES,
    LOW_HEIGHTS,
    LOW_MIN_HEIGHT,
    LOW_MIN_RETURNS,
    MIN_HEIGHT,
    MIN_RETURNS,
    ObjectCount,
)
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, centimetres, percent
from gp_ground_seg.lab.scoring.tables import make_report
from gp_ground_seg.lab.simulation import LOW, PLACES, STEEP

CROWDED = (*(name for name in PLACES if name not in (*LOW, *STEEP)), 'urban')
"""Scenes where objects hide the ground."""
ROUGH = ('rough', 'road_then_rubble', 'ramp', 'ditch', 'crest', 'blind_slope', *STEEP)
"""Scenes of rough and of steep ground."""
BANDS = {'0-10 m': slice(0, 1), '10-20 m': slice(1, 2), '> 20 m': slice(2, None)}
"""Bands of range of the columns, as parts of `scoring.objects.BAND_TITLES`."""
COUNTED = {'vehicles': ('vehicle',), 'persons': ('person', 'cyclist')}
"""Classes of `scoring.objects.CLASSES` by column."""
LOST = (
    f'vehicles, persons and cyclists with at least {MIN_RETURNS} returns from {MIN_HEIGHT:g} m '
    'above the exact ground, and how many are lost: more than half of these returns called ground'
)
"""Title of the columns of `_lost_objects`."""


def score_scenes(
    frames: Sequence[SimulatedFrame],
    config: Config,
    runner: Runner = HERE,
    *,
    with_peer: bool = True,
) -> Report:
    """Score simulated scans by exact labels and heights, and count objects and low things lost.

    Patchwork++ beside it has its published parameters and the true height of the sensor. All
    sensors have one set of parameters. Rough and steep ground has a table of its own, in which
    ours is there twice: as it is, and with the true height of the sensor.
    """
    every, refused = score_simulated(frames, config, runner, with_peer=with_peer, told_in=ROUGH)
    told = [score for score in every if score.name == TOLD]
    scores = [score for score in every if score.name != TOLD]
    low = [name for name in scores[0].sequences if name.split()[1] in LOW]
    rest = [name for name in scores[0].sequences if name not in low]
    tables = {'scenes': scene_table(scores, refused)}
    if rest:
        tables['objects'] = lost_table([score.of(*rest) for score in scores])
    if low:
        tables['low'] = low_table([score.of(*low) for score in scores])
    if told:
        tables['rough'] = rough_table([scores[0], *told, *scores[1:]])
    return make_report(tables, every, config)


def score_objects(
    frames: Sequence[SimulatedFrame],
    config: Config,
    runner: Runner = HERE,
    *,
    with_peer: bool = True,
) -> Report:
    """Count vehicles, persons and cyclists of simulated scans that are called ground.

    Beside Patchwork++ with its published parameters and the true height and place of the sensor.
    All sensors have one set of parameters.
    """
    scores, refused = score_simulated(frames, config, runner, with_peer=with_peer)
    tables = {'objects': lost_table(scores, refused), 'vehicles': return_table(scores)}
    return make_report(tables, scores, config)


def _groups(scores: Sequence[MethodScore]) -> list[tuple[str, Row, list[MethodScore]]]:
    """Each sensor and scene: its name, the first cells of its row, ours and the peer's score."""
    return [
        (name, list(zip((Column('sensor'), Column('scene')), name.split(), strict=True)),
         [score.of(name) for score in scores])
        for name in scores[0].sequences
    ]  # fmt: skip


def _of_each(column: Column, values: Sequence[float | int]) -> Row:
    """Cells of ours and of the peer, if there is one."""
    ours = replace(column, key=column.key or column.title)
    columns = ours, replace(ours, title=f'peer {column.title}', key=f'peer_{ours.key}')
    return list(zip(columns[: len(values)], values, strict=True))


def _lost_objects(parts: Sequence[MethodScore]) -> Row:
    """Cells of the objects, and of how many are lost by ours and by the peer, if there is one."""
    row: Row = []
    for title, classes in COUNTED.items():
        bands = [[score.objects.get(kind, ()) for kind in classes] for score in parts]
        counts = [sum(itertools.chain(*found), ObjectCount()) for found in bands]
        row.append((Column(title, '_d'), counts[0].n_objects))
        row += _of_each(Column('lost', '_d', f'lost_{title}'), [c.n_lost for c in counts])
    return row


def scene_table(scores: Sequence[MethodScore], refused: Sequence[str] = ()) -> Table:
    """One row for each sensor and scene; a note says where the peer is ahead in IoU."""
    rows: list[Row] = []
    behind, ties = [], []
    for name, row, parts in _groups(scores):
        height = parts[0].height
        share = ratio(height.n_without_model, height.n_points + height.n_without_model)
        row += _of_each(percent('IoU', 'iou'), [score.iou for score in parts])
        row += _of_each(centimetres('RMSE', 'rmse'), [score.height.rmse for score in parts])
        medians = [score.height.median_absolute for score in parts]
        row += _of_each(centimetres('median', 'median_absolute'), medians)
        row.append((percent('gaps', 'share_without_model'), share))
        if len(parts) > 1:
            difference, interval = parts[0].iou - parts[1].iou, interval_text(parts[0], parts[1])
            row += [(percent('ahead', 'difference', '+.2f'), difference), (INTERVAL, interval)]
            if interval is not None and interval.endswith('tie'):
                ties.append(name)
            elif not difference > 0.0:
                behind.append(name)
        rows.append(row)
    n_scans = {len(score.scans) for _, score in scores[0].by_sequence()[:-1]}
    title = (
        f'{" or ".join(map(str, sorted(n_scans)))} simulated scans per row; IoU against exact '
        'labels [%], every point counts; '
        'height of the surface under true ground [cm]; gaps: share of it without a model [%]'
    )
    notes = [*refused]
    if len(scores) > 1:
        peer = scores[1].title
        title += (
            f'; peer: {peer}, which gets the true sensor height; its surface is the nearest patch'
            '; 95 % interval: bootstrap over the scenes of each row; tie: it holds 0'
        )
        where = f'; ties on {", ".join(ties)}' if ties else ''
        where += f'; behind on {", ".join(behind)}' if behind else ''
        n_ahead = len(rows) - len(behind) - len(ties)
        notes.append(f'ahead of {peer} on {n_ahead} of {len(rows)} rows{where}')
    return Table(rows, title, notes)


def lost_table(scores: Sequence[MethodScore], refused: Sequence[str] = ()) -> Table:
    """Objects lost; ours, then the peer if there is one."""
    rows: list[Row] = []
    behind, lost = [], []
    for name, row, parts in _groups(scores):
        row += _of_each(percent('IoU', 'iou'), [score.iou for score in parts])
        if parts[0].iou < parts[-1].iou:
            behind.append(name)
        objects = _lost_objects(parts)
        row += objects
        counts = {column.key or column.title: value for column, value in objects}
        for title in COUNTED:
            if counts[f'lost_{title}']:
                lost.append(f'{name} {counts[f"lost_{title}"]} of {counts[title]} {title}')
        rows.append(row)
    title = f'IoU of the ground against exact labels [%]; {LOST}'
    notes = [*refused, f'objects lost: {", ".join(lost) or "none"}']
    if len(scores) > 1:
        peer = scores[1].title
        title += f'; peer: {peer}, which gets the true height and place of the sensor'
        notes.append(f'IoU behind {peer}: {", ".join(behind) or "nowhere"}')
    return Table(rows, title, notes)


def low_table(scores: Sequence[MethodScore]) -> Table:
    """Lay out the share of low things lost, by height; ours, then the peer if there is one."""
    rows: list[Row] = []
    for _, row, parts in _groups(scores):
        counts = {
            f'{height:g} m': [sum(s.objects.get(name, ()), ObjectCount()) for s in parts]
            for name, height in zip(LOW_CLASSES, LOW_HEIGHTS, strict=True)
        }
        row.append((Column('things', '_d'), sum(found[0].n_objects for found in counts.values())))
        for title, found in counts.items():
            lost = [ratio(count.n_lost, count.n_objects) for count in found]
            names = (title, title), ('peer', f'peer_{title}')
            columns = [percent(*pair, '.0f') for pair in names[: len(lost)]]
            row += zip(columns, lost, strict=True)
        rows.append(row)
    title = (
        'Low things by height, in plain view 3 to 20 m away: those with at least '
        f'{LOW_MIN_RETURNS} returns from {LOW_MIN_HEIGHT:g} m above the exact ground, and the '
        'share of them that is lost [%]: more than half of these returns called ground'
    )
    title += f'; peer: {scores[1].title}' if len(scores) > 1 else ''
    return Table(rows, title)


def rough_table(scores: Sequence[MethodScore]) -> Table:
    """One row for each scene that ours is told the height in; ours, told, the peer if any."""
    names = scores[1].sequences
    rows = []
    for scene in dict.fromkeys(name.split()[1] for name in names):
        own = [name for name in names if name.split()[1] == scene]
        rows.append(_rough_row(scene, [[score.of(name) for name in own] for score in scores]))
    means: Row = [(rows[0][0][0], ALL)]
    for cells in itertools.islice(zip(*rows, strict=True), 1, None):
        values = [value for _, value in cells]
        is_count = isinstance(values[0], int)
        means.append((cells[0][0], sum(values) if is_count else fmean(values)))
    title = (
        'Rough and steep ground, means over the sensors: IoU against exact labels [%], every '
        'point counts; RMSE of the surface under true ground [cm]; vehicles, persons and crates, '
        'and how many of these objects are lost, as in the other tables; told: '
        f'{scores[0].title} with the true height of the sensor'
    )
    title += f'; peer: {scores[2].title} with the same' if len(scores) > 2 else ''
    return Table([*rows, means], title, n_sums=1)


def _rough_row(scene: str, methods: Sequence[Sequence[MethodScore]]) -> Row:
    """Cells of a scene, from the scores of each method with each sensor."""
    counts = [sum(map(counts_of_all, scores), ObjectCount()) for scores in methods]
    row: Row = [
        (Column('scene'), scene),
        (Column('scans', 'd'), sum(len(score.scans) for score in methods[0])),
        (Column('objects', '_d'), counts[0].n_objects),
    ]
    measures: list[tuple[Column, list[float] | list[int]]] = [
        (percent('IoU', 'iou'), [fmean(s.iou for s in scores) for scores in methods]),
        (
            centimetres('RMSE', 'rmse'),
            [fmean(s.height.rmse for s in scores) for scores in methods],
        ),
        (Column('lost', '_d', 'lost'), [count.n_lost for count in counts]),
    ]
    for column, values in measures:
        others = [
            replace(column, title=who, key=f'{who}_{column.key}') for who in ('told', 'peer')
        ]
        row += zip([column, *others[: len(values) - 1]], values, strict=True)
    return row


def return_table(scores: Sequence[MethodScore]) -> Table:
    """Lay out the returns on vehicles by range; ours, then the peer if there is one."""
    rows: list[Row] = []
    more = []
    for name, row, parts in _groups(scores):
        for title, band in BANDS.items():
            counts = [sum(s.objects.get('vehicle', ())[band], ObjectCount()) for s in parts]
            shares = [count.share_ground for count in counts]
            row += _of_each(percent(title), shares)
            if shares[0] > shares[-1]:
                more.append(f'{name} {title}')
        rows.append(row)
    title = (
        f'Share of the returns on vehicles from {MIN_HEIGHT:g} m above the exact ground that is '
        'called ground, by range [%]'
    )
    more_text = f'more than {scores[-1].title}: {", ".join(more) or "nowhere"}'
    return Table(rows, title, [more_text] if len(scores) > 1 else [])
