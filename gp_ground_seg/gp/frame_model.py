"""The two coupled processes of one frame: inliers, learning, surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gp_ground_seg.backend import Backend
from gp_ground_seg.frame import BoolArray, Candidates, FloatArray, IntArray, Lines, PseudoInputs
from gp_ground_seg.gp.growth import GrowthTask
from gp_ground_seg.gp.learning import Learned, learn
from gp_ground_seg.gp.objective import TrainingFrame
from gp_ground_seg.gp.theta import ThetaSpace, theta_centre, theta_space
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.pipeline.labelling import LabelTask
from gp_ground_seg.pipeline.length_scale import (
    candidate_log_length_scale,
    interpolate_along_segments,
)

_NO_KNOTS = np.empty(0)
# Like the edges of the bins: for compiled code what may be written to is another type.
_NO_KNOTS.setflags(write=False)


@dataclass(frozen=True)
class FrameModel:
    """One frame's candidates and pseudo-inputs under a configuration.

    Theta has one row per segment, (M, 5 + K), so that segments may differ;
    learned over the whole frame its rows are equal.

    Attributes
    ----------
    config : Config
        Parameters.
    backend : Backend
        Who computes.
    candidates : Candidates
        Ground candidates.
    prior_mean : float
        Prior mean of the ground's height [m].
    lines : Lines
        Lines through them.
    pseudo : PseudoInputs
        Pseudo-inputs of the latent process.
    follows : (C,) bool
        Candidates that join the inliers if the one before them has.
    knots : (K,) float64
        Ranges where the surface is wanted [m].
    """

    config: Config
    backend: Backend
    candidates: Candidates
    prior_mean: float
    lines: Lines
    pseudo: PseudoInputs
    follows: BoolArray
    knots: FloatArray

    def given_theta(self) -> FloatArray:
        """Theta before anything is learned, the same in every segment, (M, 5 + K)."""
        centre = theta_centre(self.config, self.pseudo.first_guess)
        result = np.empty((len(self.candidates.offsets) - 1, len(centre)))
        result[:] = centre
        return result

    def space(self) -> ThetaSpace:
        """Bounds, priors and starting values of theta for this frame."""
        return theta_space(self.config, self.pseudo.first_guess)

    def _given_log_length_scales(self, knots: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log length-scales at the candidates (C,) and knots (M, K) without a latent process.

        NaN behind the bin of the last candidate: nothing is known of the ground there.
        """
        u = candidate_log_length_scale(self.candidates, self.lines, self.config.length_scale)
        knot_u = interpolate_along_segments(self.candidates, u, knots)
        n_knots = np.minimum(self.candidates.n_edges, len(knots))
        return u, np.where(np.arange(len(knots)) < n_knots[:, None], knot_u, np.nan)

    def grow(
        self,
        theta: FloatArray,
        knots: FloatArray,
        n_neighbours: int = 0,
        segment_step: int = 1,
        to_label: LabelTask | None = None,
    ) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
        """Inliers (C,) that grow from low, near seeds; see `surface` for what else."""
        task = GrowthTask(
            self.candidates,
            self.prior_mean,
            self.follows,
            knots,
            theta,
            self.config.observation,
            self.config.growth,
            segment_step,
            n_neighbours,
        )
        if self.config.length_scale.model == 'latent':
            return self.backend.grow_on_latent(task, self.pseudo, to_label)
        u, knot_u = self._given_log_length_scales(knots)
        return *self.backend.grow(task, u, knot_u, to_label), knot_u

    def surface(
        self, theta: FloatArray, to_label: LabelTask | None = None
    ) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
        """Inliers (C,); at the knots (M, K): height, its std [m], log l.

        Height and std are fused with those of the segments beside. What is `to_label` by
        them other threads may go on to.
        """
        return self.grow(theta, self.knots, self.config.surface.n_neighbours, to_label=to_label)

    def learn(
        self, theta: FloatArray, out_of_time: Callable[[], bool]
    ) -> tuple[FloatArray, list[Learned]]:
        """Learn theta on the inliers that grow under it (paper, section III-E)."""
        by_frame = self.config.learning.scope == 'frame'
        step = self.config.learning.segment_step if by_frame else 1
        inlier, *_ = self.grow(theta, _NO_KNOTS, segment_step=step)
        frame = self._training_frame(theta, inlier)
        if by_frame:
            learned = [self._learn_one(theta[0], frame, out_of_time)]
            return np.tile(learned[0].theta, (len(theta), 1)), learned
        learned = [
            self._learn_one(row, _one_segment(frame, m), out_of_time)
            for m, row in enumerate(theta)
        ]
        return np.array([one.theta for one in learned]), learned

    def _learn_one(
        self, start: FloatArray, frame: TrainingFrame, out_of_time: Callable[[], bool]
    ) -> Learned:
        learning = self.config.learning
        is_map = learning.objective == 'map'
        return learn(
            lambda theta: self.backend.objective(
                theta, frame, self.config.observation.slope_std, not is_map
            ),
            self.space(),
            start,
            len(frame.r),
            use_priors=is_map,
            max_evaluations=learning.max_evaluations,
            out_of_time=out_of_time,
        )

    def _training_frame(self, theta: FloatArray, inlier: BoolArray) -> TrainingFrame:
        offsets = self.candidates.offsets
        taken = np.concatenate([[0], np.cumsum(inlier)])
        latent = self.config.length_scale.model == 'latent'
        u = (
            np.zeros(int(inlier.sum()))
            if latent
            else self._given_log_length_scales(_NO_KNOTS)[0][inlier]
        )
        return TrainingFrame(
            offsets=taken[offsets],
            r=self.candidates.r[inlier],
            z=self.candidates.z[inlier] - self.prior_mean,
            log_length_scale=u,
            bar_offsets=self.pseudo.offsets if latent else np.zeros_like(offsets),
            r_bar=self.pseudo.r_bar,
            surface_class=self.pseudo.surface_class,
        )


def _one_segment(frame: TrainingFrame, m: int) -> TrainingFrame:
    own = slice(frame.offsets[m], frame.offsets[m + 1])
    bar = slice(frame.bar_offsets[m], frame.bar_offsets[m + 1])

    def ends(part: slice) -> IntArray:
        return np.array([0, part.stop - part.start])

    return TrainingFrame(
        ends(own),
        frame.r[own],
        frame.z[own],
        frame.log_length_scale[own],
        ends(bar),
        frame.r_bar[bar],
        frame.surface_class[bar],
    )
