"""Simulated scenes beside Patchwork++: IoU and height, and objects that are called ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.cluster import HERE, Runner
from gp_ground_seg.lab.experiments.variants import TOLD, SimulatedFrame, score_simulated
from gp_ground_seg.lab.scoring.comparison import INTERVAL, RMSE, interval_text, iou_measure
from gp_ground_seg.lab.scoring.evaluate import ALL, Scores, each, sums, title_of
from gp_ground_seg.lab.scoring.metrics import ratio
from gp_ground_seg.lab.scoring.objects import (
    BAND_TITLES,
    LOW_CLASSES,
    LOW_HEIGHTS,
    LOW_MIN_HEIGHT,
    LOW_MIN_RETURNS,
    MIN_HEIGHT,
    MIN_RETURNS,
    OBJECT_COUNTS,
)
from gp_ground_seg.lab.scoring.report import Column, Report, Table, centimetres, percent
from gp_ground_seg.lab.scoring.tables import make_report, share_without_model
from gp_ground_seg.lab.simulation import LOW, PLACES, STEEP

if TYPE_CHECKING:
    from pandas import DataFrame, Series

CROWDED = (*(name for name in PLACES if name not in (*LOW, *STEEP)), 'urban')
"""Scenes where objects hide the ground."""
ROUGH = ('rough', 'road_then_rubble', 'ramp', 'ditch', 'crest', 'blind_slope', *STEEP)
"""Scenes of rough and of steep ground."""
BANDS = {'0-10 m': slice(0, 1), '10-20 m': slice(1, 2), '> 20 m': slice(2, None)}
"""Bands of range of the columns, as parts of `scoring.objects.BAND_TITLES`."""
COUNTED = {'vehicles': ('vehicle',), 'persons': ('person', 'cyclist')}
"""Classes of `scoring.objects.CLASSES` by column."""
IOU = iou_measure('exact')
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
    told = every.of([TOLD])
    scores = every.of([name for name in every.methods if name != TOLD])
    low = [name for name in scores.sequences if name.split()[1] in LOW]
    rest = [name for name in scores.sequences if name not in low]
    tables = {'scenes': scene_table(scores, refused)}
    if rest:
        tables['objects'] = lost_table(scores.of(sequences=rest))
    if low:
        tables['low'] = low_table(scores.of(sequences=low))
    if told.methods:
        tables['rough'] = rough_table(every.of(sequences=told.sequences))
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


def _places(scores: Scores) -> dict[Column, Any]:
    """Columns of the sensors and the scenes, in whose order all others are."""
    sensors, scenes = zip(*(name.split() for name in scores.sequences), strict=True)
    return {Column('sensor'): sensors, Column('scene'): scenes}


def _of_each(column: Column, values: Sequence[Series]) -> dict[Column, Any]:
    """Columns of ours and of the peer, if there is one."""
    ours = replace(column, key=column.key or column.title)
    columns = ours, replace(ours, title=f'peer {column.title}', key=f'peer_{ours.key}')
    return dict(zip(columns, values, strict=False))


def _where(scores: Scores, is_so: Series) -> list[str]:
    """Names of the sequences of which something is so."""
    return [name for name in scores.sequences if is_so[name]]


def _objects(scores: Scores, is_wanted: Series) -> list[DataFrame]:
    """`OBJECT_COUNTS` of each method in each sequence, of some rows; 0 where there are none."""
    wanted = scores.objects[is_wanted]
    own = (wanted[wanted['method'] == method] for method in scores.methods)
    by_sequence = (rows.groupby('sequence')[[*OBJECT_COUNTS]].sum() for rows in own)
    return [found.reindex(scores.sequences, fill_value=0) for found in by_sequence]


def scene_table(scores: Scores, refused: Sequence[str] = ()) -> Table:
    """One row for each sensor and scene; a note says where the peer is ahead in IoU."""
    found = each(sums(scores.scans, 'sequence'), scores.methods)
    medians = scores.scans.groupby(['method', 'sequence'], sort=False)['median_absolute'].median()
    iou = [IOU.of(own) for own in found]
    columns = {
        **_places(scores),
        **_of_each(percent('IoU', 'iou'), iou),
        **_of_each(centimetres('RMSE', 'rmse'), [RMSE.of(own) for own in found]),
        **_of_each(centimetres('median', 'median_absolute'), each(medians, scores.methods)),
        percent('gaps', 'share_without_model'): share_without_model(found[0]),
    }
    n_scans = ' or '.join(map(str, sorted({*found[0]['n_scans'].tolist()})))
    title = (
        f'{n_scans} simulated scans per row; IoU against exact '
        'labels [%], every point counts; '
        'height of the surface under true ground [cm]; gaps: share of it without a model [%]'
    )
    notes = [*refused]
    for name in scores.methods[1:]:
        peer, difference = title_of(name), iou[0] - iou[1]
        intervals = {
            where: interval_text(scores.of(sequences=[where]), name, IOU)
            for where in scores.sequences
        }
        columns |= {percent('ahead', 'difference', '+.2f'): difference}
        columns |= {INTERVAL: intervals.values()}
        title += (
            f'; peer: {peer}, which gets the true sensor height; its surface is the nearest patch'
            '; 95 % interval: bootstrap over the scenes of each row; tie: it holds 0'
        )
        ties = [where for where, text in intervals.items() if text and text.endswith('tie')]
        behind = [where for where in _where(scores, ~(difference > 0.0)) if where not in ties]
        where = f'; ties on {", ".join(ties)}' if ties else ''
        where += f'; behind on {", ".join(behind)}' if behind else ''
        n_ahead = len(intervals) - len(behind) - len(ties)
        notes.append(f'ahead of {peer} on {n_ahead} of {len(intervals)} rows{where}')
    return Table(columns, title, notes)


def lost_table(scores: Scores, refused: Sequence[str] = ()) -> Table:
    """Objects lost; ours, then the peer if there is one."""
    iou = [IOU.of(own) for own in each(sums(scores.scans, 'sequence'), scores.methods)]
    columns = {**_places(scores), **_of_each(percent('IoU', 'iou'), iou)}
    words: dict[str, list[str]] = {name: [] for name in scores.sequences}
    for title, classes in COUNTED.items():
        found = _objects(scores, scores.objects['class'].isin(classes))
        n_objects, n_lost = found[0]['n_objects'], found[0]['n_lost']
        columns[Column(title, '_d')] = n_objects
        columns |= _of_each(
            Column('lost', '_d', f'lost_{title}'), [own['n_lost'] for own in found]
        )
        for name in _where(scores, n_lost > 0):
            words[name].append(f'{name} {n_lost[name]} of {n_objects[name]} {title}')
    lost = [line for lines in words.values() for line in lines]
    title = f'IoU of the ground against exact labels [%]; {LOST}'
    notes = [*refused, f'objects lost: {", ".join(lost) or "none"}']
    for name in scores.methods[1:]:
        peer = title_of(name)
        title += f'; peer: {peer}, which gets the true height and place of the sensor'
        behind = ', '.join(_where(scores, iou[0] < iou[1]))
        notes.append(f'IoU behind {peer}: {behind or "nowhere"}')
    return Table(columns, title, notes)


def low_table(scores: Scores) -> Table:
    """Lay out the share of low things lost, by height; ours, then the peer if there is one."""
    n_things = _objects(scores, scores.objects['class'].isin(LOW_CLASSES))[0]['n_objects']
    columns = {**_places(scores), Column('things', '_d'): n_things}
    for name, height in zip(LOW_CLASSES, LOW_HEIGHTS, strict=True):
        title = f'{height:g} m'
        found = _objects(scores, scores.objects['class'] == name)
        names = (title, title), ('peer', f'peer_{title}')
        for pair, own in zip(names, found, strict=False):
            columns[percent(*pair, '.0f')] = ratio(own['n_lost'], own['n_objects'])
    title = (
        'Low things by height, in plain view 3 to 20 m away: those with at least '
        f'{LOW_MIN_RETURNS} returns from {LOW_MIN_HEIGHT:g} m above the exact ground, and the '
        'share of them that is lost [%]: more than half of these returns called ground'
    )
    title += f'; peer: {title_of(scores.methods[1])}' if scores.methods[1:] else ''
    return Table(columns, title)


def rough_table(scores: Scores) -> Table:
    """One row for each scene that ours is told the height in; ours, told, the peer if any."""
    found = sums(scores.scans, 'sequence').reset_index()
    found = found.assign(
        scene=found['sequence'].str.split().str[1], iou=IOU.of(found), rmse=RMSE.of(found)
    )
    by_scene = found.groupby(['method', 'scene'], sort=False)
    counts = by_scene[['n_scans', 'n_objects', 'n_lost']].sum()
    means = by_scene[['iou', 'rmse']].mean()
    others = [name for name in scores.methods if name not in (scores.methods[0], TOLD)]
    methods = {'': scores.methods[0], 'told': TOLD, **dict(zip(['peer'], others, strict=False))}
    ours = counts.loc[scores.methods[0]]

    def lines(values: Series, *, are_counts: bool = False) -> list[Any]:
        """Values of the scenes, and below them their sum or mean."""
        return [*values, values.sum() if are_counts else values.mean()]

    columns: dict[Column, Any] = {
        Column('scene'): [*ours.index, ALL],
        Column('scans', 'd'): lines(ours['n_scans'], are_counts=True),
        Column('objects', '_d'): lines(ours['n_objects'], are_counts=True),
    }
    for column, values in (
        (percent('IoU', 'iou'), means['iou']),
        (centimetres('RMSE', 'rmse'), means['rmse']),
        (Column('lost', '_d', 'lost'), counts['n_lost']),
    ):
        for who, method in methods.items():
            own = replace(column, title=who, key=f'{who}_{column.key}') if who else column
            columns[own] = lines(values[method], are_counts=column.key == 'lost')
    title = (
        'Rough and steep ground, means over the sensors: IoU against exact labels [%], every '
        'point counts; RMSE of the surface under true ground [cm]; vehicles, persons and crates, '
        'and how many of these objects are lost, as in the other tables'
    )
    title += f'; peer: {title_of(others[0])}, which gets the true height' if others else ''
    return Table(columns, title, [f'told: {scores.methods[0]} with the true height'], n_sums=1)


def return_table(scores: Scores) -> Table:
    """Lay out the returns on vehicles by range; ours, then the peer if there is one."""
    columns, more = _places(scores), {name: list[str]() for name in scores.sequences}
    vehicles = scores.objects['class'] == 'vehicle'
    for title, band in BANDS.items():
        is_there = vehicles & scores.objects['range'].isin(BAND_TITLES[band])
        found = _objects(scores, is_there)
        shares = [ratio(own['n_ground'], own['n_returns']) for own in found]
        columns |= _of_each(percent(title), shares)
        for name in _where(scores, shares[0] > shares[-1]):
            more[name].append(f'{name} {title}')
    title = (
        f'Share of the returns on vehicles from {MIN_HEIGHT:g} m above the exact ground that is '
        'called ground, by range [%]'
    )
    where = ', '.join(line for lines in more.values() for line in lines)
    notes = [f'more than {title_of(name)}: {where or "nowhere"}' for name in scores.methods[1:]]
    return Table(columns, title, notes)
