"""Run methods over labelled frames and score them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.semantic_kitti import (
    Frame,
    list_frames,
    list_sequences,
    read_labels,
    read_points,
)
from gp_ground_seg.errors import DataError, PointCloudError
from gp_ground_seg.evaluation.calibration import count_calibration
from gp_ground_seg.evaluation.conventions import CONVENTIONS, GROUNDGRID
from gp_ground_seg.evaluation.methods import Method
from gp_ground_seg.evaluation.rings import count_rings
from gp_ground_seg.evaluation.scores import FrameScore, MethodScore, count_classes, count_confusion

Observer = Callable[[str, Frame, FrameScore, npt.NDArray[np.uint8]], None]
"""Looks at a frame as it is scored: method, frame, score, labels."""


def labelled_frames(root: str | Path, sequences: Sequence[str] | None = None) -> list[Frame]:
    """Frames of the named sequences, or of all, in order; each has labels.

    Raises
    ------
    DataError
        If a sequence is not there or named twice, or a frame has no labels.
    """
    known = list_sequences(root)
    chosen = known if sequences is None else list(sequences)
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen:
        problem = f'no sequence {", ".join(unknown)}' if chosen else 'no sequence asked for'
        raise DataError(f'{root}: {problem}; sequences here: {", ".join(known)}')
    if len(set(chosen)) < len(chosen):
        raise DataError(f'sequences {", ".join(chosen)}: one is named twice')
    frames = {name: list_frames(root, name) for name in chosen}
    bare = {name: [f for f in found if f.labels_path is None] for name, found in frames.items()}
    for name, missing in bare.items():
        if missing:
            labelled = [other for other in chosen if not bare[other]]
            hint = f'; wholly labelled: {",".join(labelled)}' if labelled else ''
            raise DataError(
                f'{root}: {len(missing)} of {len(frames[name])} frames of sequence {name} have '
                f'no labels, the first is {missing[0].index}{hint}'
            )
    return [frame for name in chosen for frame in frames[name]]


def evaluate(
    frames: Sequence[Frame],
    methods: Sequence[Method],
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[Sequence[Frame]], Iterable[Frame]] = iter,
    observe: Observer | None = None,
) -> list[MethodScore]:
    """Score methods on the same frames, run alternately.

    Before the first frame counts, each method runs on it once: compiling and
    first allocations are not its speed.

    Parameters
    ----------
    frames : sequence of Frame
        Labelled frames, grouped by sequence.
    methods : sequence of Method
        What to score. Which goes first changes from frame to frame.
    clock : callable
        Source of seconds.
    progress : callable
        Wraps the frames to show how far it is, as tqdm does.
    observe : callable, optional
        Called with the name of the method, the frame, its score and its labels (N,)
        as soon as a frame is scored: scores alone are kept.

    Returns
    -------
    list of MethodScore
        In the order of `methods`.

    Raises
    ------
    DataError
        If a file cannot be read or does not fit its frame.
    PointCloudError
        If a method refuses a scan.
    """
    if frames:
        points = read_points(frames[0].points_path)
        for method in methods:
            method.start_sequence()
            _run(method, frames[0], points)
    scores: dict[str, list[FrameScore]] = {method.name: [] for method in methods}
    sequence = None
    for k, frame in enumerate(progress(frames)):
        if frame.sequence != sequence:
            sequence = frame.sequence
            for method in methods:
                method.start_sequence()
        points = read_points(frame.points_path)
        assert frame.labels_path is not None, 'labelled_frames gives only labelled ones'
        semantic = read_labels(frame.labels_path, len(points))
        for method in methods if k % 2 == 0 else reversed(methods):
            start = clock()
            _run(method, frame, points)
            seconds = clock() - start
            label = method.label()
            score = _score_frame(frame, method, seconds, points, semantic, label)
            scores[method.name].append(score)
            if observe is not None:
                observe(method.name, frame, score, label)
    return [MethodScore(name, tuple(found)) for name, found in scores.items()]


def _run(method: Method, frame: Frame, points: npt.NDArray[np.float32]) -> None:
    try:
        method.run(points)
    except PointCloudError as error:
        raise PointCloudError(f'{frame.points_path}: {method.name}: {error}') from error


def _score_frame(
    frame: Frame,
    method: Method,
    seconds: float,
    points: npt.NDArray[np.float32],
    semantic: npt.NDArray[np.uint16],
    label: npt.NDArray[np.uint8],
) -> FrameScore:
    p_ground = method.p_ground()
    truth = {
        convention.key: convention.truth(semantic, points[:, 2]) for convention in CONVENTIONS
    }
    return FrameScore(
        sequence=frame.sequence,
        index=frame.index,
        seconds=seconds,
        stages=method.stages(),
        confusions={key: count_confusion(label, true_label) for key, true_label in truth.items()},
        classes=count_classes(label, semantic),
        rings=count_rings(label, truth[GROUNDGRID.key], points),
        calibration=(
            None if p_ground is None else count_calibration(p_ground, truth[GROUNDGRID.key])
        ),
        facts=method.facts(),
    )
