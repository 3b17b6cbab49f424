"""Objects of simulated scans that are called ground, by scene, sensor and range."""

from __future__ import annotations

from collections.abc import Sequence

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.evaluation import evaluate as methods
from gp_ground_seg.evaluation.evaluate import MethodScore, Progress
from gp_ground_seg.evaluation.objects import MIN_HEIGHT, MIN_RETURNS, ObjectCount
from gp_ground_seg.evaluation.patchworkpp import PatchworkppMethod
from gp_ground_seg.evaluation.report import Column, Report, Row, Table, percent
from gp_ground_seg.experiments.variants import (
    PEER,
    load_simulated,
    make_report,
    score_variants,
    simulated_frames,
)
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.simulation import PLACES, SENSORS

SCENES = (*PLACES, 'urban')
"""Scenes where objects hide the ground."""
BANDS = {'0-10 m': slice(0, 1), '10-20 m': slice(1, 2), '> 20 m': slice(2, None)}
"""Bands of range of the columns, as parts of `evaluation.objects.BAND_TITLES`."""


def score_objects(
    sensors: Sequence[str],
    scenes: Sequence[str],
    n_seeds: int,
    config: Config,
    with_peer: bool,
    progress: Progress = iter,
) -> Report:
    """Segment `n_seeds` simulated scenes of each name by each sensor, and count lost objects.

    A sensor and scene of which a scan is refused is left out, and a note says why.
    """
    found: list[list[MethodScore]] = []
    refused = []
    cases = [(sensor, scene) for sensor in sensors for scene in scenes]
    for sensor, scene in progress(cases):
        frames = simulated_frames([sensor], [scene], n_seeds, (0.0,))
        peers = [PatchworkppMethod(SENSORS[sensor].height_of_cloud)] if with_peer else []
        try:
            scores = score_variants(frames, load_simulated, {methods.OURS: config}, peers)
        except PointCloudError as error:
            refused.append(f'refused: {error}')
        else:
            found.append(scores)
    if not found:
        raise PointCloudError('; '.join(refused))
    pooled = [methods.pool(own[0].name, own) for own in zip(*found, strict=True)]
    return make_report({'objects': lost_table(pooled, refused)}, pooled, config)


def lost_table(scores: Sequence[MethodScore], refused: Sequence[str] = ()) -> Table:
    """One row for each sensor and scene: ours, then the peer if there is one."""
    rows: list[Row] = []
    behind: dict[str, list[str]] = {'IoU': [], 'vehicles': [], 'lost': []}
    for group in scores[0].sequences:
        own = [score.of(group) for score in scores]
        sensor, scene = group.split()
        row: Row = [(Column('sensor'), sensor), (Column('scene'), scene)]
        row += _of_each(percent('IoU', 'iou'), [score.iou for score in own])
        if own[0].iou < own[-1].iou:
            behind['IoU'].append(group)
        for title, band in BANDS.items():
            bands = [score.objects.get('vehicle', ())[band] for score in own]
            shares = [sum(one, ObjectCount()).share_ground for one in bands]
            row += _of_each(percent(title), shares)
            if shares[0] > shares[-1]:
                behind['vehicles'].append(f'{group} {title}')
        for title, names in (('vehicles', ('vehicle',)), ('persons', ('person', 'cyclist'))):
            counts = [
                sum((one for name in names for one in score.objects.get(name, ())), ObjectCount())
                for score in own
            ]
            row.append((Column(title, '_d'), counts[0].n_objects))
            row += _of_each(Column('lost', '_d', f'lost_{title}'), [c.n_lost for c in counts])
            if counts[0].n_lost:
                behind['lost'].append(f'{group} {counts[0].n_lost} {title}')
        rows.append(row)
    title = (
        f'IoU of the ground against exact labels [%]; share of the returns on vehicles from '
        f'{MIN_HEIGHT:g} m above the exact ground that is called ground, by range [%]; vehicles, '
        f'persons and cyclists with at least {MIN_RETURNS} such returns, and how many are lost: '
        f'more than half of these returns called ground'
    )
    notes = [*refused]
    if len(scores) > 1:
        title += f'; its: of {PEER}, which has the true height of the cloud'
        notes += [
            f'IoU behind {PEER}: {", ".join(behind["IoU"]) or "nowhere"}',
            f'more of vehicles than {PEER}: {", ".join(behind["vehicles"]) or "nowhere"}',
        ]
    notes.append(f'objects lost: {", ".join(behind["lost"]) or "none"}')
    return Table.of(rows, title=title, notes=notes)


def _of_each(column: Column, values: Sequence[float | int]) -> Row:
    """Cells of ours and of the peer."""
    key = column.key or column.title
    its = Column('its', column.format, f'peer_{key}', column.scale)
    return list(
        zip((Column(column.title, column.format, key, column.scale), its), values, strict=False)
    )
