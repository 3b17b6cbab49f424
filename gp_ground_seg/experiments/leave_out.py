"""Parameters chosen on all sequences but one and scored on that one."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

from gp_ground_seg.data.semantic_kitti import Frame, read_labels, read_points
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.calibration import Calibration, count_calibration
from gp_ground_seg.evaluation.conventions import GROUNDGRID
from gp_ground_seg.evaluation.scores import Confusion, count_confusion
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.segmenter import GroundSegmenter

Choice = dict[str, ParameterValue]
"""A value for each parameter that is searched, by dotted name."""


@dataclass(frozen=True)
class SequenceScore:
    """Counts over one or several sequences, GroundGrid convention."""

    confusion: Confusion
    calibration: Calibration

    def __add__(self, other: SequenceScore) -> SequenceScore:
        """Add the counts of both."""
        return SequenceScore(
            self.confusion + other.confusion, self.calibration + other.calibration
        )


def pool(scores: Iterable[SequenceScore]) -> SequenceScore:
    """Sum of the counts of at least one sequence."""
    return functools.reduce(operator.add, scores)


class ConfigScorer:
    """Scores configurations on labelled frames, each configuration once.

    Parameters
    ----------
    frames : sequence of Frame
        Labelled frames; each is segmented without a past.
    base : Config
        What the choices change.
    progress : callable
        Wraps the frames of each configuration to show how far it is, as tqdm does.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        base: Config,
        progress: Callable[[Sequence[Frame]], Iterable[Frame]] = iter,
    ) -> None:
        self._frames = frames
        self._base = base
        self._progress = progress
        self._known: dict[tuple[tuple[str, ParameterValue], ...], dict[str, SequenceScore]] = {}

    @property
    def n_configurations(self) -> int:
        """How many different ones were scored."""
        return len(self._known)

    def scores(self, choice: Mapping[str, ParameterValue]) -> dict[str, SequenceScore]:
        """Score a choice, by sequence.

        Raises
        ------
        ConfigError
            If a value is not accepted.
        DataError
            If a file cannot be read or does not fit its frame.
        """
        key = tuple(sorted(choice.items()))
        if key not in self._known:
            self._known[key] = self._run(self._base.replace(**choice))
        return self._known[key]

    def _run(self, config: Config) -> dict[str, SequenceScore]:
        found: dict[str, SequenceScore] = {}
        with closing(GroundSegmenter(config)) as segmenter:
            for frame in self._progress(self._frames):
                points = read_points(frame.points_path)
                assert frame.labels_path is not None, 'labelled_frames gives only labelled ones'
                semantic = read_labels(frame.labels_path, len(points))
                truth = GROUNDGRID.truth(semantic, points[:, 2])
                segmenter.reset()
                result = segmenter.segment(points)
                score = SequenceScore(
                    count_confusion(result.label, truth),
                    count_calibration(result.p_ground, truth),
                )
                before = found.get(frame.sequence)
                found[frame.sequence] = score if before is None else before + score
        return found


def coordinate_search(
    grid: Mapping[str, Sequence[ParameterValue]],
    start: Choice,
    worth: Callable[[Choice], float],
) -> Choice:
    """Improve one parameter after the other until none can be.

    Parameters
    ----------
    grid : mapping of str to sequence
        Values to try, by name of the parameter.
    start : dict
        First choice.
    worth : callable
        What is maximised; of equal choices the earlier one stays.

    Returns
    -------
    dict
        A choice that no change of a single parameter betters.
    """
    best = dict(start)
    highest = worth(best)
    better = True
    while better:
        better = False
        for name, values in grid.items():
            for value in values:
                trial = {**best, name: value}
                if (found := worth(trial)) > highest:
                    best, highest, better = trial, found, True
    return best


@dataclass(frozen=True)
class Fold:
    """A sequence, the values chosen on all others, and its score with them."""

    left_out: str
    choice: Choice
    score: SequenceScore


@dataclass(frozen=True)
class LeaveOut:
    """Outcome of a leave-one-sequence-out search.

    Attributes
    ----------
    start : dict
        Values of the base configuration.
    base : dict of str to SequenceScore
        Its scores by sequence.
    tuned_choice : dict
        Values chosen on all sequences.
    tuned : dict of str to SequenceScore
        Their scores on the same sequences.
    folds : tuple of Fold
        One for each sequence.
    n_configurations : int
        Configurations that were scored.
    """

    start: Choice
    base: dict[str, SequenceScore]
    tuned_choice: Choice
    tuned: dict[str, SequenceScore]
    folds: tuple[Fold, ...]
    n_configurations: int

    @property
    def left_out(self) -> SequenceScore:
        """Sum over the folds, each sequence with the values chosen without it."""
        return pool(fold.score for fold in self.folds)


def leave_one_out(
    frames: Sequence[Frame],
    base: Config,
    grid: Mapping[str, Sequence[ParameterValue]],
    progress: Callable[[Sequence[Frame]], Iterable[Frame]] = iter,
) -> LeaveOut:
    """Choose values by pooled IoU, once on all sequences and once without each.

    Parameters
    ----------
    frames : sequence of Frame
        Labelled frames of at least two sequences.
    base : Config
        Where each search starts.
    grid : mapping of str to sequence
        Values to try beside those of `base`, by name of the parameter.
    progress : callable
        As `ConfigScorer`.

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
        raise DataError('leave-out: needs at least two sequences')
    # As the configuration holds them: 1 and 1.0 are the same value, told once.
    tried = {name: [base.replace(**{name: v})[name] for v in grid[name]] for name in grid}
    start: Choice = {name: base[name] for name in grid}
    scorer = ConfigScorer(frames, base, progress)

    def chosen_on(names: Sequence[str]) -> Choice:
        def iou(choice: Choice) -> float:
            scores = scorer.scores(choice)
            return pool(scores[name] for name in names).confusion.iou

        return coordinate_search(tried, start, iou)

    tuned_choice = chosen_on(sequences)
    folds = []
    for name in sequences:
        choice = chosen_on([other for other in sequences if other != name])
        folds.append(Fold(name, choice, scorer.scores(choice)[name]))
    return LeaveOut(
        start=start,
        base=scorer.scores(start),
        tuned_choice=tuned_choice,
        tuned=scorer.scores(tuned_choice),
        folds=tuple(folds),
        n_configurations=scorer.n_configurations,
    )
