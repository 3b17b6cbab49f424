"""Parameters chosen on all sequences but one and scored on that one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.evaluate import (
    ALL,
    MethodScore,
    Progress,
    load_kitti,
    pool,
)
from gp_ground_seg.evaluation.table import Cell, Column, Table, percent
from gp_ground_seg.experiments.variants import (
    Report,
    make_report,
    score_variants,
)
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.schema import ParameterValue

Choice = dict[str, ParameterValue]
"""A value for each parameter that is searched, by dotted name."""
Grid = Mapping[str, Sequence[ParameterValue]]


def coordinate_search(grid: Grid, start: Choice, worth: Callable[[Choice], float]) -> Choice:
    """Improve one parameter after the other until none can be.

    Parameters
    ----------
    grid : mapping of str to sequence
        Values to try, by name of the parameter.
    start : dict
        First choice.
    worth : callable
        What is maximised; of equal choices the earlier one stays.
    """
    best, highest = dict(start), worth(start)
    better = True
    while better:
        better = False
        for name, values in grid.items():
            for value in values:
                trial = {**best, name: value}
                if (found := worth(trial)) > highest:
                    best, highest, better = trial, found, True
    return best


def cross_validate(
    frames: Sequence[Frame], base: Config, grid: Grid, progress: Progress = iter
) -> Report:
    """Choose values by pooled IoU, once on all sequences and once without each.

    Each configuration segments every frame once, however many searches need it.

    Parameters
    ----------
    frames : sequence of Frame
        Labelled frames of at least two sequences.
    base : Config
        Where each search starts.
    grid : mapping of str to sequence
        Values to try beside those of `base`, by name of the parameter.
    progress : callable
        Wraps the frames of each configuration, as tqdm does.

    Raises
    ------
    ConfigError
        If a value is not accepted; before any frame is read, unless it takes two
        parameters to see.
    DataError
        If there are too few sequences or a file cannot be read.
    """
    sequences = list(dict.fromkeys(frame.sequence for frame in frames))
    if len(sequences) < 2:
        raise DataError('cross-validation: needs at least two sequences')
    # As the configuration holds them: 1 and 1.0 are one value.
    tried = {name: [base.replace(**{name: v})[name] for v in grid[name]] for name in grid}
    start: Choice = {name: base[name] for name in grid}
    known: dict[tuple[ParameterValue, ...], MethodScore] = {}

    def score(choice: Choice) -> MethodScore:
        key = tuple(choice[name] for name in grid)
        if key not in known:
            variant = {str(len(known)): base.replace(**choice)}
            (known[key],) = score_variants(frames, load_kitti, variant, progress=progress)
        return known[key]

    def choose(names: Sequence[str]) -> Choice:
        return coordinate_search(tried, start, lambda choice: score(choice).of(*names).iou)

    choices = {'given': start, 'tuned': choose(sequences)}
    for left_out in sequences:
        choices[f'- {left_out}'] = choose([name for name in sequences if name != left_out])
    scores = {'given': score(start), 'tuned': score(choices['tuned'])}
    scores['left out'] = pool(
        'left out', (score(choices[f'- {name}']).of(name) for name in sequences)
    )
    tables = {
        'scores': _score_table(scores, sequences, len(known)),
        'choices': _choice_table(choices),
    }
    named = [MethodScore(name, one.scans) for name, one in scores.items()]
    return make_report(tables, named, base, n_configurations=len(known), tried=tried)


def _score_table(
    scores: dict[str, MethodScore], sequences: Sequence[str], n_configurations: int
) -> Table:
    columns = [Column('sequence')]
    columns += [percent(f'IoU {name} [%]', f'iou {name}') for name in scores]
    columns += [Column(f'ECE {name}', '.4f') for name in scores]
    rows: list[list[Cell]] = []
    for name in (*sequences, ALL):
        own = [one if name == ALL else one.of(name) for one in scores.values()]
        rows.append([name, *(one.iou for one in own), *(one.ece for one in own)])
    title = (
        'IoU and expected calibration error, GroundGrid convention: as given; with the values '
        f'best on all {len(sequences)} sequences (tuned); each sequence with the values best on '
        f'the others (left out). {n_configurations} configurations scored.'
    )
    return Table(columns, rows, title, n_sums=1)


def _choice_table(choices: dict[str, Choice]) -> Table:
    """Values chosen: a row for each parameter, a column for each search."""
    rows = [
        [name, *(_shown(choice[name]) for choice in choices.values())] for name in choices['given']
    ]
    columns = [Column('parameter'), *(Column(name, 's') for name in choices)]
    return Table(columns, rows, 'Values chosen; - 00: without sequence 00')


def _shown(value: ParameterValue) -> str:
    return f'{value:g}' if isinstance(value, float) else str(value).lower()
