"""Scores on simulated scans of flat and rough ground, where labels and heights are exact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gp_ground_seg.evaluation.evaluate import MethodScore, Progress, pool
from gp_ground_seg.evaluation.methods import OURS, PATCHWORKPP, TITLES, PatchworkppMethod
from gp_ground_seg.evaluation.metrics import ratio
from gp_ground_seg.evaluation.report import (
    Column,
    Report,
    Row,
    Table,
    centimetres,
    changed_parameters,
    percent,
)
from gp_ground_seg.experiments.variants import (
    load_simulated,
    make_report,
    score_variants,
    simulated_frames,
)
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.simulation import SENSORS

PRESET_OF = {
    'hdl-64e': 'hdl64',
    'hdl-32e': 'hdl32',
    'vlp-16': 'vlp16',
    'os1-128': 'os1_128',
    'mid-360': 'mid360',
}
"""Preset that goes with each simulated sensor."""
PLACES = (0.0, 6.0)
"""Where the sensor stands in each scene [m]."""
PEER = TITLES[PATCHWORKPP]


def score_scenes(
    configs: Mapping[str, Config],
    scenes: Sequence[str],
    n_seeds: int,
    with_peer: bool,
    progress: Progress = iter,
) -> Report:
    """Segment `n_seeds` simulated scenes of each name, seen from `PLACES`, by each sensor.

    `configs` are our parameters by name of the sensor; the peer, Patchwork++, runs on the same
    clouds with the true height of the sensor.
    """
    ours, theirs = [], []
    for sensor, config in configs.items():
        frames = simulated_frames([sensor], scenes, n_seeds, PLACES)
        peers = [PatchworkppMethod(SENSORS[sensor].height)] if with_peer else []
        own, *other = score_variants(
            frames, load_simulated, {OURS: config}, peers, progress=progress
        )
        ours.append(own)
        theirs += other
    scores = [pool(OURS, ours), *([pool(PATCHWORKPP, theirs)] if theirs else [])]
    report = make_report({'scenes': scene_table(*scores)}, scores, Config())
    for name, of in (('config_changes', changed_parameters), ('config', Config.nested)):
        report.facts[name] = {sensor: of(config) for sensor, config in configs.items()}
    return report


def scene_table(ours: MethodScore, peer: MethodScore | None = None) -> Table:
    """One row for each sensor and scene; the note says where the peer is ahead in IoU."""
    rows: list[Row] = []
    behind = []
    for group in ours.sequences:
        own = ours.of(group)
        height, (sensor, scene) = own.height(), group.split()
        share = ratio(height.n_without_model, height.n_points + height.n_without_model)
        rows.append(
            [
                (Column('sensor'), sensor),
                (Column('scene'), scene),
                (percent('IoU', 'iou'), own.iou),
                (centimetres('RMSE', 'rmse'), height.rmse),
                (centimetres('median', 'median_absolute'), height.median_absolute),
                (percent('no model', 'share_without_model'), share),
            ]
        )
        if peer is not None:
            its = peer.of(group)
            rows[-1] += [
                (percent(PEER, 'peer_iou'), its.iou),
                (percent('difference', 'difference', '+.2f'), own.iou - its.iou),
                (centimetres('its RMSE', 'peer_rmse'), its.height().rmse),
                (centimetres('its median', 'peer_median_absolute'), its.height().median_absolute),
            ]
            if not own.iou > its.iou:
                behind.append(group)
    n_scans = len(ours.of(ours.sequences[0]).scans)
    title = (
        f'{n_scans} simulated scans per row; IoU against exact labels [%], every point counts; '
        'height of the surface under true ground [cm]; share of it without a model [%]'
    )
    notes = []
    if peer is not None:
        title += f'; {PEER} has the true sensor height, its surface is that of its nearest patch'
        where = f'; behind on {", ".join(behind)}' if behind else ''
        notes = [f'ahead of {PEER} on {len(rows) - len(behind)} of {len(rows)} rows{where}']
    return Table.of(rows, title=title, notes=notes)
