"""Table and plain data of the simulated scenes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from gp_ground_seg.cli.output import count
from gp_ground_seg.cli.tables import percent
from gp_ground_seg.evaluation.scores import RATIOS
from gp_ground_seg.experiments.scene_scores import SceneScore

Table = tuple[list[str], list[list[str]]]
"""Header and rows."""
PEER = 'Patchwork++'


def scenes_title(ours: Sequence[SceneScore], with_peer: bool) -> str:
    """One line on what is in the table."""
    scans = ours[0].scans
    n_seeds = len({scan.scan.seed for scan in scans})
    per_row = count(len(scans), 'simulated scan')
    peer = (
        f'; {PEER} knows the true sensor height, its surface is the plane of its nearest patch'
        if with_peer
        else ''
    )
    return (
        f'{per_row} per row, of {count(n_seeds, "scene")} each; IoU against exact labels [%], '
        f'every point counts; height of the surface under true ground [cm]; share of it without a '
        f'model [%]{peer}'
    )


def scenes_table(ours: Sequence[SceneScore], peer: Sequence[SceneScore]) -> Table:
    """Table of the scenes, a row for each sensor and scene."""
    header = ['sensor', 'scene', 'IoU', 'RMSE', 'median', 'no model']
    if peer:
        header = ['sensor', 'scene', 'IoU', PEER, 'difference', 'RMSE', 'its', 'median']
        header += ['its', 'no model']
    rows = []
    for k, own in enumerate(ours):
        iou, height = own.pooled.iou, own.height
        row = [own.sensor, own.scene, percent(iou)]
        if peer:
            its, its_height = peer[k].pooled.iou, peer[k].height
            row += [percent(its), percent(iou - its, sign=True)]
            row += [_centimetres(height.rmse), _centimetres(its_height.rmse)]
            row += [_centimetres(one.median_absolute) for one in (height, its_height)]
        else:
            row += [_centimetres(height.rmse), _centimetres(height.median_absolute)]
        rows.append([*row, percent(own.share_without_model)])
    return header, rows


def scenes_behind(ours: Sequence[SceneScore], peer: Sequence[SceneScore]) -> str:
    """One line on where the peer is ahead in IoU."""
    behind = [
        f'{own.scene} ({own.sensor})'
        for own, its in zip(ours, peer, strict=True)
        if not own.pooled.iou > its.pooled.iou
    ]
    n_ahead = len(ours) - len(behind)
    where = f'; behind on {", ".join(behind)}' if behind else ''
    return f'ahead of {PEER} on {n_ahead} of {count(len(ours), "row")}{where}'


def scenes_data(scores: Sequence[SceneScore]) -> list[dict[str, Any]]:
    """Every number of one method, in JSON's own types."""
    return [
        {
            'sensor': one.sensor,
            'scene': one.scene,
            **_numbers(one),
            'share_without_model': _defined(one.share_without_model),
            'median_ms': 1e3 * one.median_seconds,
            'scans': [
                {'seed': scan.scan.seed, 'x': scan.scan.x, 'ms': 1e3 * scan.seconds}
                | _numbers(SceneScore(one.sensor, one.scene, (scan,)))
                for scan in one.scans
            ],
        }
        for one in scores
    ]


def _numbers(one: SceneScore) -> dict[str, Any]:
    confusion, height = one.pooled, one.height
    return {
        **{name: getattr(confusion, name) for name in ('tp', 'fp', 'fn', 'tn')},
        **{name: _defined(getattr(confusion, name)) for name in RATIOS},
        'height': {
            'n_points': height.n_points,
            'n_without_model': height.n_without_model,
            **{
                name: _defined(getattr(height, name))
                for name in ('rmse', 'median_absolute', 'bias')
            },
        },
    }


def _centimetres(metres: float) -> str:
    return '-' if math.isnan(metres) else f'{100.0 * metres:.2f}'


def _defined(value: float) -> float | None:
    return None if math.isnan(value) else value
