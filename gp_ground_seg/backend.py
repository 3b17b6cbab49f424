"""Who computes a frame: plain numpy, or compiled code in threads."""

from __future__ import annotations

import logging
from typing import Protocol

import numpy as np

from gp_ground_seg.compiled.workspace import Workspace
from gp_ground_seg.errors import MissingDependencyError
from gp_ground_seg.frame import (
    BoolArray,
    Candidates,
    FloatArray,
    GroundSurface,
    Labelled,
    Lines,
    PointArray,
    PseudoInputs,
)
from gp_ground_seg.gp.growth import GrowthTask
from gp_ground_seg.gp.numpy_backend import NumpyBackend as NumpyBackend
from gp_ground_seg.gp.objective import TrainingFrame
from gp_ground_seg.jit import HAVE_NUMBA
from gp_ground_seg.parameters.config import Config, RuntimeConfig
from gp_ground_seg.pipeline.labelling import LabelTask
from gp_ground_seg.pipeline.sorted_points import SortedPoints

_LOGGER = logging.getLogger('gp_ground_seg')
_said_slow = False


class Backend(Protocol):
    """What the segmenter asks of a backend; theta has one row per segment."""

    name: str
    n_threads: int

    def sort_points(
        self, xyz: PointArray, config: Config, workspace: Workspace, seeks_faces: bool = True
    ) -> SortedPoints:
        """Points of a level frame in columns, sorted into bins and tiles.

        See `gp_ground_seg.pipeline.points.in_columns`, `gp_ground_seg.pipeline.polar_grid`,
        `gp_ground_seg.pipeline.tiles`, `gp_ground_seg.pipeline.faces`. All but the grid and the
        candidates may lie in `workspace`. If `seeks_faces`, other threads begin with them:
        they, or that they are dropped, are to be waited for before the points change and
        before anything is asked of the backend but to sort other points without faces.
        """

    def find_lines(
        self, candidates: Candidates, is_footless: BoolArray, config: Config
    ) -> tuple[Candidates, Lines, PseudoInputs, BoolArray]:
        """Candidates that show ground, lines through them, pseudo-inputs, and who follows whom.

        See `gp_ground_seg.pipeline.hidden_feet.without_hidden_feet`,
        `gp_ground_seg.pipeline.line_extraction.extract_lines`,
        `gp_ground_seg.pipeline.pseudo_inputs.select_pseudo_inputs` and
        `gp_ground_seg.pipeline.line_bends.candidates_that_follow`.
        """

    def grow(
        self,
        task: GrowthTask,
        log_length_scale: FloatArray,
        knot_log_length_scale: FloatArray,
        to_label: LabelTask | None = None,
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """See `gp_ground_seg.gp.growth.grow_surface_reference`; log length-scales (C,), (M, K).

        The surface is fused, see `pipeline.surface.fuse_neighbours`. Other threads may
        go on to label by it what is `to_label`: that is to be asked for next.
        """

    def grow_on_latent(
        self, task: GrowthTask, pseudo: PseudoInputs, to_label: LabelTask | None = None
    ) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
        """Both processes: `gp_ground_seg.gp.latent.latent_rows_reference`, then `grow`.

        What `grow` gives, and the log length-scales at the knots (M, K) [log m].
        """

    def label_points(self, task: LabelTask, surface: GroundSurface) -> Labelled:
        """See `gp_ground_seg.pipeline.labelling`."""

    def objective(
        self, theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """See `gp_ground_seg.gp.objective.objective_reference`."""

    def close(self) -> None:
        """End worker threads."""


def choose_backend(wanted: str) -> str:
    """Return ``numba`` or ``numpy`` for the parameter ``runtime.backend``.

    Raises
    ------
    MissingDependencyError
        If numba is asked for by name and not installed.
    """
    global _said_slow
    if wanted == 'numba' and not HAVE_NUMBA:
        raise MissingDependencyError(
            'runtime.backend = numba, but numba is not installed: pip install numba, '
            'or set runtime.backend to auto'
        )
    if wanted == 'auto' and not HAVE_NUMBA and not _said_slow:
        _said_slow = True
        _LOGGER.warning(
            'numba is not installed: using numpy, several times slower (pip install numba)'
        )
    return 'numba' if HAVE_NUMBA and wanted != 'numpy' else 'numpy'


def make_backend(runtime: RuntimeConfig) -> Backend:
    """Backend for the parameters ``runtime``; raises as `choose_backend`."""
    # Only the one that is used: the compiled code has its cache to load.
    if choose_backend(runtime.backend) == 'numpy':
        from gp_ground_seg.gp.numpy_backend import NumpyBackend

        return NumpyBackend()
    from gp_ground_seg.compiled.backend import CompiledBackend

    return CompiledBackend(runtime.n_threads)


def warm_up(config: Config | None = None) -> Backend:
    """Stub of the lead's function."""
    from gp_ground_seg.pipeline.sensor_pose import given_pose
    from gp_ground_seg.segmenter import GroundSegmenter

    config = config or Config()
    backend = make_backend(config.runtime)
    radius, azimuth = np.meshgrid(np.linspace(2.0, 32.0, 24), np.linspace(-3.1, 3.1, 64))
    pose = given_pose(config.sensor)
    height = np.full(radius.shape, -pose.height)
    level = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1)
    GroundSegmenter(config, backend=backend).segment(
        (level.reshape(-1, 3) @ pose.rotation).astype(np.float32)
    )
    return backend
