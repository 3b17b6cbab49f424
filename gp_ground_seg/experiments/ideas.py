"""Ideas beyond the paper and how to switch each off: a list to add rows to."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.experiments.ablation import MethodResult, ablate
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.schema import ParameterValue


@dataclass(frozen=True)
class Idea:
    """An idea and its switch.

    Attributes
    ----------
    title : str
        What it is, in a few words.
    changes : mapping of str to value
        Parameters, by dotted name, that switch it off; of a dropped idea, on.
    kept : bool
        Whether the defaults have it.
    """

    title: str
    changes: Mapping[str, ParameterValue]
    kept: bool = True


IDEAS: tuple[Idea, ...] = (
    Idea('latent length-scales (constant instead)', {'length_scale.model': 'constant'}),
    Idea('learning in every frame', {'learning.mode': 'fixed'}),
    Idea('objective without the latent terms', {'learning.objective': 'paper'}),
    Idea('sloping mean', {'observation.slope_std': 0.0}),
    Idea('neighbouring segments fused', {'surface.n_neighbours': 0}),
    Idea('lopsided gate of the growth', {'growth.max_standardised_depth': 2.0}),
    Idea('upright faces', {'faces.min_height': 100.0}),
    Idea('faces that hide their foot', {'faces.max_foot_distance': 0.0}),
    Idea(
        'band that follows the roughness',
        {
            'label.roughness_gain': 0.0,
            'label.obstacle_roughness_gain': 0.0,
            'label.ground_tolerance': 0.2,
        },
    ),
    Idea('narrower band beside an obstacle', {'label.obstacle_tolerance': 0.2}),
    Idea('band open downwards', {'label.below_tolerance': 0.2}),
    Idea('bins that widen, 80 of them', {'grid.n_bins': 120, 'grid.bin_growth': 1.0}),
    Idea('lines end at 0.1 rad', {'lines.slope_tolerance': 0.02}),
    Idea('length-scales of classes learned', {'learning.fixed': 'length_scales'}),
    Idea('lines followed out of the gate', {'growth.max_line_slope': 0.0}),
    Idea('lines followed round a bend', {'growth.min_bend_extent': 1000.0}),
    Idea('every third segment teaches', {'learning.segment_step': 1}),
    Idea('one theta for the frame', {'learning.scope': 'segment'}),
    Idea('240 segments', {'grid.n_segments': 240}, kept=False),
    Idea('twice the neighbours fused', {'surface.n_neighbours': 4}, kept=False),
    Idea('a wider gate (3)', {'growth.max_standardised_residual': 3.0}, kept=False),
    Idea('faces from 0.3 m on', {'faces.min_height': 0.3}, kept=False),
)
"""What is measured by default. A new idea is a new row here; nothing else has to change."""

AS_GIVEN = 'as given'
"""Title of the configuration that all others change."""


@dataclass(frozen=True)
class IdeaResult:
    """What one idea is worth on labelled frames.

    Attributes
    ----------
    idea : Idea
        Which.
    switched : MethodResult
        With its switch turned.
    given : MethodResult
        With no switch turned, on the same frames.
    """

    idea: Idea
    switched: MethodResult
    given: MethodResult

    def worth(self, sequence: str | None = None) -> float:
        """Tell what having the idea adds to the IoU, pooled or in one sequence."""
        gain = self.given.pooled(sequence).iou - self.switched.pooled(sequence).iou
        return gain if self.idea.kept else -gain

    @property
    def time_ratio(self) -> float:
        """Median over the frames of time with the switch turned over time without."""
        pairs = zip(self.switched.frames, self.given.frames, strict=True)
        return statistics.median(one.seconds / other.seconds for one, other in pairs)


def weigh_ideas(
    frames: Sequence[Frame],
    ideas: Sequence[Idea],
    config: Config,
    progress: Callable[[Sequence[Frame]], Iterable[Frame]] = iter,
) -> tuple[MethodResult, list[IdeaResult]]:
    """Turn the switch of one idea after the other, on the same frames in the same run.

    Parameters
    ----------
    frames : sequence of Frame
        Labelled frames, at least one; each is segmented without a past.
    ideas : sequence of Idea
        Each with a title of its own.
    config : Config
        What the switches change.
    progress : callable
        Wraps the frames to show how far it is, as tqdm does.

    Returns
    -------
    given : MethodResult
        With no switch turned.
    results : list of IdeaResult
        In the order of `ideas`.

    Raises
    ------
    ConfigError
        If two titles are alike, a switch is not accepted or changes nothing.
    DataError
        If a file cannot be read or does not fit its frame.
    """
    methods: dict[str, Mapping[str, ParameterValue]] = {AS_GIVEN: {}}
    for idea in ideas:
        if idea.title in methods:
            raise ConfigError(f'idea {idea.title!r}: there is one of that title already')
        if config.replace(**idea.changes) == config:
            raise ConfigError(f'idea {idea.title!r}: its switch changes nothing')
        methods[idea.title] = idea.changes
    given, *switched = ablate(frames, methods, config, progress=progress, over_defaults=False)
    results = [IdeaResult(idea, one, given) for idea, one in zip(ideas, switched, strict=True)]
    return given, results
