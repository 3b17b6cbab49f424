"""Tables and plain data of the ablations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from gp_ground_seg.cli.output import count
from gp_ground_seg.cli.tables import milliseconds, percent
from gp_ground_seg.evaluation.height_error import HeightError
from gp_ground_seg.experiments.ablation import MethodResult
from gp_ground_seg.experiments.ablation_synthetic import STRETCHES, SyntheticResult

Table = tuple[list[str], list[list[str]]]
"""Header and rows."""


def frames_title(results: Sequence[MethodResult]) -> str:
    """One line on what is in the table of labelled frames."""
    frames = results[0].frames
    n_sequences = len({frame.sequence for frame in frames})
    return (
        f'{count(len(frames), "labelled frame")} of {count(n_sequences, "sequence")}; '
        'IoU in the GroundGrid convention [%]; heights under points labelled ground [cm]'
    )


def frames_table(results: Sequence[MethodResult]) -> Table:
    """Table of labelled frames."""
    header = ['method', 'IoU', 'worst sequence', 'RMSE', 'median', 'SMSE', 'ms per frame']
    rows = []
    for result in results:
        worst, height = result.worst_sequence, result.height
        rows.append(
            [
                result.title,
                percent(result.pooled().iou),
                f'{percent(result.pooled(worst).iou)} ({worst})',
                _centimetres(height.rmse),
                _centimetres(height.median_absolute),
                f'{height.smse:.5f}',
                milliseconds(result.median_seconds),
            ]
        )
    return header, rows


def synthetic_title(results: Sequence[SyntheticResult]) -> str:
    """One line on what is in the table of simulated scans."""
    scans = results[0].scans
    n_scenes = len({scan.seed for scan in scans})
    return (
        f'{count(len(scans), "simulated scan")} of {count(n_scenes, "scene")}, road then rubble, '
        'HDL-64E; errors against the exact ground [cm]'
    )


def synthetic_table(results: Sequence[SyntheticResult]) -> Table:
    """Table of simulated scans."""
    header = ['length-scale']
    header += [f'{measure}, {stretch}' for measure in ('RMSE', 'median') for stretch in STRETCHES]
    header.append('ms per scan')
    rows = []
    for result in results:
        heights = [result.height(stretch) for stretch in STRETCHES]
        rows.append(
            [
                result.title,
                *(_centimetres(height.rmse) for height in heights),
                *(_centimetres(height.median_absolute) for height in heights),
                milliseconds(result.median_seconds),
            ]
        )
    return header, rows


def _centimetres(metres: float) -> str:
    """Format a length in centimetres, without unit."""
    return f'{100.0 * metres:.2f}'


def frames_data(result: MethodResult) -> dict[str, Any]:
    """Every number of a method on labelled frames, in JSON's own types."""
    sequences = dict.fromkeys(frame.sequence for frame in result.frames)
    return {
        'iou': _defined(result.pooled().iou),
        'sequences': {name: {'iou': _defined(result.pooled(name).iou)} for name in sequences},
        'height': _height_json(result.height),
        'median_ms': 1e3 * result.median_seconds,
        'frames': [
            {
                'sequence': frame.sequence,
                'index': frame.index,
                'ms': 1e3 * frame.seconds,
                'iou': _defined(frame.confusion.iou),
                'height': _height_json(frame.height),
            }
            for frame in result.frames
        ],
    }


def synthetic_data(result: SyntheticResult) -> dict[str, Any]:
    """Every number of a method on simulated scans, in JSON's own types."""
    return {
        'height': {stretch: _height_json(result.height(stretch)) for stretch in STRETCHES},
        'median_ms': 1e3 * result.median_seconds,
        'scans': [
            {
                'seed': scan.seed,
                'sensor_x': scan.sensor_x,
                'ms': 1e3 * scan.seconds,
                'height': {name: _height_json(error) for name, error in scan.height.items()},
            }
            for scan in result.scans
        ],
    }


def _height_json(error: HeightError) -> dict[str, float | None]:
    return {
        'n_points': error.n_points,
        'n_without_model': error.n_without_model,
        **{
            name: _defined(getattr(error, name))
            for name in ('rmse', 'median_absolute', 'bias', 'smse')
        },
    }


def _defined(value: float) -> float | None:
    return None if math.isnan(value) else value
