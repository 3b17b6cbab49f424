"""Search of parameters on labelled frames with Optuna, and a score on frames left out of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from gp_ground_seg.core.errors import ConfigError, DataError, require
from gp_ground_seg.core.parameters.config import Config, find_spec, parameter_specs
from gp_ground_seg.core.parameters.export import is_logarithmic
from gp_ground_seg.core.parameters.schema import AUTO, ParameterSpec, ParameterValue
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.semantic_kitti import Frame, read_labels, read_points
from gp_ground_seg.lab.scale.cluster import Progress, Runner
from gp_ground_seg.lab.scale.dataset import digest
from gp_ground_seg.lab.scoring.metrics import GROUNDGRID, Confusion, count_confusion

DEFAULT_NAMES = [
    spec.name
    for spec in parameter_specs()
    if spec.basic and spec.type in (int, float) and not spec.name.startswith(('sensor', 'runtime'))
]
"""Basic numbers that bear on labels and are no facts of a robot."""


class Trial(NamedTuple):
    """Values that were tried, and their IoU on the frames searched; NaN: they do not go along."""

    choice: dict[str, ParameterValue]
    iou: float


def split_frames(
    frames: Sequence[Frame], left_out: Sequence[str] | None = None
) -> tuple[list[Frame], list[Frame]]:
    """Return the frames to search on, and those left out: by default every second sequence.

    Of a single sequence it is the second half: frames drawn at random would have their like, a
    tenth of a second away, among those searched.
    """
    names = list(dict.fromkeys(frame.sequence for frame in frames))
    chosen = names[1::2] if left_out is None else left_out
    n = len(frames) // 2
    searched, rest = list(frames[:n]), list(frames[n:])
    if chosen:
        searched = [frame for frame in frames if frame.sequence not in chosen]
        rest = [frame for frame in frames if frame.sequence in chosen]
    if not searched or not rest:
        raise DataError(f'optimise: no frames to search on or to leave out, of {", ".join(names)}')
    return searched, rest


def count_frames(config: Config, frames: Sequence[Frame], progress: Progress = iter) -> Confusion:
    """Score labelled frames in the GroundGrid convention, each without a past."""
    total = Confusion()
    with closing(GroundSegmenter(config)) as segmenter:
        for frame in progress(frames):
            assert frame.labels_path is not None
            points = read_points(frame.points_path, frame.layout)
            truth = GROUNDGRID.truth(read_labels(frame.labels_path, len(points)), points[:, 2])
            segmenter.reset()
            total += count_confusion(segmenter.segment(points).label, truth)
    return total


def searched_specs(names: Sequence[str], base: Config) -> list[ParameterSpec]:
    """Return the parameters to search; ConfigError for one that has no values to begin with."""
    specs = [find_spec(name) for name in dict.fromkeys(names)]
    for spec in specs:
        if base[spec.name] == AUTO or (spec.type is str and not spec.choices):
            raise ConfigError(f'{spec.name} = {base[spec.name]}: is no number or choice to search')
    return specs


def search(
    base: Config,
    specs: Sequence[ParameterSpec],
    frames: Sequence[Frame],
    runner: Runner,
    n_trials: int,
    seed: int,
    journal: str | Path | None = None,
) -> list[Trial]:
    """Try the values of `base`, then others until there are `n_trials`, and return all.

    What is in the file `journal` is not done again. DataError if it is no journal, or that of
    another search: other parameters, or other `frames`.
    """
    optuna, journals = require('optuna', 'optuna'), require('optuna.storages.journal', 'optuna')
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage = None
    if journal is not None:
        path = Path(journal)
        try:
            data = path.read_bytes() if path.exists() else b''
            if data and not (data.startswith(b'{"op_code":') and data.endswith(b'\n')):
                raise ValueError('it is none of Optuna, or its last line is not complete')
            storage = journals.JournalStorage(journals.JournalFileBackend(str(path)))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f'{journal}: cannot be read as a journal: {error}') from error
    study = optuna.create_study(
        storage=storage, study_name='gp_ground_seg', direction='maximize', load_if_exists=True
    )
    names = [f'{frame.sequence}/{frame.index}' for frame in frames]
    mark = digest(base, seed, [spec.name for spec in specs], names)
    if (found := study.user_attrs.get('digest', mark)) != mark:
        raise DataError(
            f'{journal}: is of other parameters, frames or seed (digest {found}, here {mark}); '
            'name another journal'
        )
    study.set_user_attr('digest', mark)

    def try_one(trial: Any) -> float:
        choice = {spec.name: _suggest(trial, spec) for spec in specs}
        try:
            config = base.replace(**choice)
        except ConfigError as error:  # values that do not go along
            raise optuna.TrialPruned from error
        total = sum(runner.run(partial(count_frames, config), frames), Confusion())
        if not total.tp + total.fn:
            raise DataError('no return in the frames searched is labelled ground')
        return total.iou

    states = optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED
    n_done = len(study.get_trials(states=states))
    # A search that goes on must not draw again what it drew at its beginning.
    study.sampler = optuna.samplers.TPESampler(seed=seed + n_done)
    if not n_done:
        study.enqueue_trial({spec.name: base[spec.name] for spec in specs})
    study.optimize(try_one, n_trials=max(n_trials - n_done, 0))
    ended = study.get_trials(states=states)
    return [Trial(one.params, math.nan if one.value is None else one.value) for one in ended]


def _suggest(trial: Any, spec: ParameterSpec) -> Any:
    """Draw a value from those that are accepted."""
    if spec.choices or spec.type is bool:
        return trial.suggest_categorical(spec.name, spec.choices or (False, True))
    draw = trial.suggest_int if spec.type is int else trial.suggest_float
    low, high = (spec.type(end) for end in (spec.minimum, spec.maximum))
    return draw(spec.name, low, high, log=is_logarithmic(spec))
