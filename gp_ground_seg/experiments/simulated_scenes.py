"""Scores on simulated scans of flat and rough ground, where labels and heights are exact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gp_ground_seg.evaluation.environment import changed_parameters
from gp_ground_seg.evaluation.evaluate import (
    MethodScore,
    Progress,
    pool,
)
from gp_ground_seg.evaluation.methods import OURS, TITLES, Method, PatchworkppMethod
from gp_ground_seg.evaluation.metrics import ratio
from gp_ground_seg.evaluation.table import Cell, Column, Table, centimetres, percent
from gp_ground_seg.experiments.variants import (
    Report,
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
PEER = TITLES[PatchworkppMethod.name]


def score_scenes(
    configs: Mapping[str, Config],
    scenes: Sequence[str],
    n_seeds: int,
    with_peer: bool,
    progress: Progress = iter,
) -> Report:
    """Segment simulated scans and compare with the truth.

    Parameters
    ----------
    configs : mapping of str to Config
        Our parameters by name of the sensor.
    scenes : sequence of str
        Names of scenes.
    n_seeds : int
        Scenes of each name, each seen from `PLACES`.
    with_peer : bool
        Whether Patchwork++ runs on the same clouds, with the true height of the sensor.
    progress : callable
        Wraps the scans of each sensor, as tqdm does.

    Raises
    ------
    MissingDependencyError
        If the peer is not installed.
    """
    ours, theirs = [], []
    for sensor, config in configs.items():
        frames = simulated_frames([sensor], scenes, n_seeds, PLACES)
        peers: list[Method] = [PatchworkppMethod(SENSORS[sensor].height)] if with_peer else []
        own, *other = score_variants(
            frames, load_simulated, {OURS: config}, peers, progress=progress
        )
        ours.append(own)
        theirs += other
    scores = [pool(OURS, ours), *([pool(PatchworkppMethod.name, theirs)] if theirs else [])]
    report = make_report({'scenes': scene_table(*scores)}, scores, Config())
    report.facts['config_changes'] = {s: changed_parameters(c) for s, c in configs.items()}
    return report


def scene_table(ours: MethodScore, peer: MethodScore | None = None) -> Table:
    """One row for each sensor and scene; the note says where the peer is ahead in IoU."""
    rows: list[list[Cell]] = []
    behind = []
    for group in ours.sequences:
        own = ours.of(group)
        height = own.height()
        n_ground = height.n_points + height.n_without_model
        row: list[Cell] = [*group.split(), own.iou, height.rmse, height.median_absolute]
        row.append(ratio(height.n_without_model, n_ground))
        if peer is not None:
            its = peer.of(group)
            row += [its.iou, own.iou - its.iou, its.height().rmse, its.height().median_absolute]
            if not own.iou > its.iou:
                behind.append(group)
        rows.append(row)
    columns = [
        Column('sensor'),
        Column('scene'),
        percent('IoU', 'iou'),
        centimetres('RMSE', 'rmse'),
        centimetres('median', 'median_absolute'),
        percent('no model', 'share_without_model'),
    ]
    n_scans = len(ours.of(ours.sequences[0]).scans)
    title = (
        f'{n_scans} simulated scans per row; IoU against exact labels [%], every point counts; '
        'height of the surface under true ground [cm]; share of it without a model [%]'
    )
    notes = []
    if peer is not None:
        columns += [
            percent(PEER, 'peer_iou'),
            percent('difference', 'difference', '+.2f'),
            centimetres('its RMSE', 'peer_rmse'),
            centimetres('its median', 'peer_median_absolute'),
        ]
        title += f'; {PEER} has the true sensor height, its surface is that of its nearest patch'
        where = f'; behind on {", ".join(behind)}' if behind else ''
        notes = [f'ahead of {PEER} on {len(rows) - len(behind)} of {len(rows)} rows{where}']
    return Table(columns, rows, title, notes)
