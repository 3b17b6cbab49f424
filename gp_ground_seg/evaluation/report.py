"""An evaluation as plain data, ready for JSON."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from gp_ground_seg.evaluation.calibration import BIN_EDGES, THRESHOLDS, Calibration
from gp_ground_seg.evaluation.class_errors import class_errors
from gp_ground_seg.evaluation.conventions import CONVENTIONS, GROUNDGRID
from gp_ground_seg.evaluation.environment import Environment
from gp_ground_seg.evaluation.rings import ring_titles
from gp_ground_seg.evaluation.scores import RATIOS, Confusion, MethodScore
from gp_ground_seg.evaluation.semantic_classes import class_name
from gp_ground_seg.parameters.config import Config, parameter_specs
from gp_ground_seg.parameters.schema import ParameterValue


def changed_parameters(config: Config) -> dict[str, ParameterValue]:
    """Parameters that differ from their defaults, by dotted name."""
    return {
        spec.name: config[spec.name]
        for spec in parameter_specs()
        if config[spec.name] != spec.default
    }


def report(
    scores: list[MethodScore],
    config: Config,
    environment: Environment,
    n_threads: int,
    backend: str,
    data: str,
) -> dict[str, Any]:
    """Everything of an evaluation in JSON's own types; NaN as None.

    Parameters
    ----------
    scores : list of MethodScore
        Ours first, then peers.
    config : Config
        Parameters of ours.
    environment : Environment
        Where it ran.
    n_threads, backend : int, str
        What ours really used.
    data : str
        Where the frames are.
    """
    ours = scores[0]
    document = {
        'data': data,
        'n_frames': len(ours.frames),
        'sequences': ours.sequences,
        'config_changes': changed_parameters(config),
        'config': config.nested(),
        'n_threads': n_threads,
        'backend': backend,
        'environment': dataclasses.asdict(environment),
        'conventions': {convention.key: convention.rule for convention in CONVENTIONS},
        'methods': {score.name: _method(score) for score in scores},
        'median_time_ratio': {
            peer.name: ours.median_seconds / peer.median_seconds for peer in scores[1:]
        },
    }
    plain: dict[str, Any] = _without_nan(document)
    return plain


def write_json(document: dict[str, Any], path: str | Path) -> None:
    """Write a report."""
    text = json.dumps(document, indent=2, allow_nan=False) + '\n'
    Path(path).write_text(text, encoding='utf-8')


def _method(score: MethodScore) -> dict[str, Any]:
    return {
        'pooled': {c.key: _confusion(score.pooled(c.key)) for c in CONVENTIONS},
        'sequences': {
            sequence: {c.key: _confusion(score.pooled(c.key, sequence)) for c in CONVENTIONS}
            for sequence in score.sequences
        },
        'rings': dict(zip(ring_titles(), map(_confusion, score.rings()), strict=False)),
        'classes': _classes(score),
        'calibration': _calibrations(score),
        'ms_per_frame': {
            'median': 1e3 * score.median_seconds,
            'mean': 1e3 * score.mean_seconds,
            'median_of_stages': {
                stage: 1e3 * seconds for stage, seconds in score.median_stage_seconds().items()
            },
        },
        'frames': [
            {
                'sequence': frame.sequence,
                'index': frame.index,
                'ms': 1e3 * frame.seconds,
                **frame.facts,
                **{c.key: _confusion(frame.confusions[c.key]) for c in CONVENTIONS},
            }
            for frame in score.frames
        ],
    }


def _classes(score: MethodScore) -> dict[str, Any]:
    errors = score.pooled(GROUNDGRID.key).errors
    found = sorted(class_errors(score.classes()), key=lambda one: one.number)
    n_points = sum(one.points for one in found)
    return {
        str(one.number): {
            'name': class_name(one.number),
            'counts_as': one.truth.name.lower(),
            'points': one.points,
            'share_points': one.points / n_points,
            'labelled_ground': one.labelled_ground,
            'share_ground': one.labelled_ground / one.points,
            'missed_ground': one.missed,
            'false_ground': one.false,
            'share_errors': one.errors / errors if errors else math.nan,
        }
        for one in found
    }


def _calibrations(score: MethodScore) -> dict[str, Any] | None:
    pooled = score.calibration()
    if pooled is None:
        return None
    found = {name: score.calibration(name) for name in score.sequences}
    return {
        'pooled': _calibration(pooled),
        'sequences': {name: _calibration(one) for name, one in found.items() if one is not None},
    }


def _calibration(one: Calibration) -> dict[str, Any]:
    step = one.best_step
    return {
        'points': one.n_total,
        'points_without': one.ground_without + one.obstacles_without,
        'ece': one.ece,
        'brier': one.brier,
        'best_threshold': float(THRESHOLDS[step]),
        'iou_at_best_threshold': one.confusion_at(step).iou,
        'bins': {
            'edges': BIN_EDGES.tolist(),
            'points': one.n_points.tolist(),
            'mean_p': one.mean_p.tolist(),
            'share_ground': one.share_ground.tolist(),
        },
    }


def _confusion(confusion: Confusion) -> dict[str, int | float]:
    ratios = {name: getattr(confusion, name) for name in RATIOS}
    return {**dataclasses.asdict(confusion), **ratios}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and math.isnan(value) else value
