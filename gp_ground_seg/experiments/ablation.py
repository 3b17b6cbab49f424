"""What the length-scale model and the learning are worth on labelled frames."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass

import numpy as np

from gp_ground_seg.data.semantic_kitti import Frame, read_labels, read_points
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.conventions import GROUNDGRID
from gp_ground_seg.evaluation.height_error import HeightError, height_error, pool_height_errors
from gp_ground_seg.evaluation.scores import Confusion, count_confusion
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config, find_spec
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.result import FitReport
from gp_ground_seg.segmenter import GroundSegmenter

_FIXED: dict[str, ParameterValue] = {'learning.mode': 'fixed'}
_WHOLE_FRAME: dict[str, ParameterValue] = {
    'learning.mode': 'every_frame',
    'learning.scope': 'frame',
}
_PER_SEGMENT: dict[str, ParameterValue] = {
    'learning.mode': 'every_frame',
    'learning.scope': 'segment',
}

METHODS: dict[str, dict[str, ParameterValue]] = {
    'constant, not learned': {'length_scale.model': 'constant', **_FIXED},
    'constant, learned': {'length_scale.model': 'constant', **_WHOLE_FRAME},
    'Z, not learned': {'length_scale.model': 'line_gradient', **_FIXED},
    'Z, learned': {'length_scale.model': 'line_gradient', **_WHOLE_FRAME},
    'Z-L, not learned': {'length_scale.model': 'latent', **_FIXED},
    'Z-L, learned per segment': {'length_scale.model': 'latent', **_PER_SEGMENT},
    'Z-L, learned over the frame': {'length_scale.model': 'latent', **_WHOLE_FRAME},
}
"""Methods by title, as changes of the configuration; the last one is the paper's."""


@dataclass(frozen=True)
class FrameResult:
    """How one method did on one frame.

    Attributes
    ----------
    sequence, index : str
        Which frame.
    seconds : float
        Time of the segmentation alone, without reading.
    confusion : Confusion
        In the GroundGrid convention.
    height : HeightError
        Of the surface under the points labelled ground.
    """

    sequence: str
    index: str
    seconds: float
    confusion: Confusion
    height: HeightError


@dataclass(frozen=True)
class MethodResult:
    """How one method did on all frames; `fit` is the report of its last one."""

    title: str
    frames: tuple[FrameResult, ...]
    fit: FitReport

    def pooled(self, sequence: str | None = None) -> Confusion:
        """Sum of the counts over one sequence, or over all."""
        chosen = (f for f in self.frames if sequence is None or f.sequence == sequence)
        return sum((frame.confusion for frame in chosen), Confusion())

    @property
    def worst_sequence(self) -> str:
        """Name of the sequence with the lowest IoU."""
        names = dict.fromkeys(frame.sequence for frame in self.frames)
        return min(names, key=lambda name: self.pooled(name).iou)

    @property
    def height(self) -> HeightError:
        """Height error over all frames."""
        return pool_height_errors([frame.height for frame in self.frames])

    @property
    def median_seconds(self) -> float:
        """Median time per frame."""
        return statistics.median(frame.seconds for frame in self.frames)


@contextmanager
def open_segmenters(
    methods: Mapping[str, Mapping[str, ParameterValue]],
    config: Config,
    over_defaults: bool = True,
) -> Iterator[dict[str, GroundSegmenter]]:
    """Yield a segmenter for each method's changes of `config`; their threads end afterwards.

    Raises
    ------
    ConfigError
        If a change is not accepted, or with `over_defaults` if `config` itself
        changes what the methods set.
    """
    names = {name for changes in methods.values() for name in changes}
    for name in sorted(names) if over_defaults else ():
        if config[name] != find_spec(name).default:
            raise ConfigError(
                f'{name} = {config[name]}: the methods compared set it, leave it out'
            )
    configs = {title: config.replace(**changes) for title, changes in methods.items()}
    with ExitStack() as stack:
        yield {
            title: stack.enter_context(closing(GroundSegmenter(own)))
            for title, own in configs.items()
        }


def ablate(
    frames: Sequence[Frame],
    methods: Mapping[str, Mapping[str, ParameterValue]],
    config: Config,
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[Sequence[Frame]], Iterable[Frame]] = iter,
    over_defaults: bool = True,
) -> list[MethodResult]:
    """Run methods on the same frames, alternately.

    Parameters
    ----------
    frames : sequence of Frame
        Labelled frames, at least one; each is segmented without a past.
    methods : mapping of str to mapping
        Changes of the configuration, by title of the method.
    config : Config
        The configuration that they change.
    clock : callable
        Source of seconds.
    progress : callable
        Wraps the frames to show how far it is, as tqdm does.
    over_defaults : bool
        As `open_segmenters`.

    Raises
    ------
    ConfigError
        As `open_segmenters`.
    DataError
        If a file cannot be read or does not fit its frame.
    """
    results: dict[str, list[FrameResult]] = {title: [] for title in methods}
    fits: dict[str, FitReport] = {}
    with open_segmenters(methods, config, over_defaults) as segmenters:
        points = read_points(frames[0].points_path)
        for segmenter in segmenters.values():  # compiling is not their speed
            segmenter.segment(points)
        for k, frame in enumerate(progress(frames)):
            points = read_points(frame.points_path)
            assert frame.labels_path is not None, 'labelled_frames gives only labelled ones'
            semantic = read_labels(frame.labels_path, len(points))
            z = points[:, 2].astype(np.float64)
            truth = GROUNDGRID.truth(semantic, z)
            is_ground = truth == Label.GROUND
            for title in methods if k % 2 == 0 else reversed(list(methods)):
                segmenters[title].reset()
                started = clock()
                result = segmenters[title].segment(points)
                seconds = clock() - started
                fits[title] = result.fit
                results[title].append(
                    FrameResult(
                        frame.sequence,
                        frame.index,
                        seconds,
                        count_confusion(result.label, truth),
                        height_error(z[is_ground], result.ground_z[is_ground]),
                    )
                )
    return [MethodResult(title, tuple(found), fits[title]) for title, found in results.items()]
