"""Compute backends: the stages of a frame in plain numpy, or compiled with numba."""

from __future__ import annotations

import logging
from typing import Protocol

from gp_ground_seg.core.errors import MissingDependencyError, install_hint
from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    Faces,
    FloatArray,
    Frame,
    GroundSurface,
    Labelled,
    Lines,
    PointArray,
    PseudoInputs,
    Scan,
)
from gp_ground_seg.core.gp import ground, learning
from gp_ground_seg.core.gp.learning import Learned
from gp_ground_seg.core.jit import HAVE_NUMBA
from gp_ground_seg.core.parameters.config import Config, RuntimeConfig
from gp_ground_seg.core.pipeline import (
    ground_plane,
    labels,
    lines,
    mirror_images,
    polar_grid,
    relief,
    vertical_faces,
)
from gp_ground_seg.core.pipeline.points import Direction
from gp_ground_seg.core.pipeline.relief import Relief

_LOGGER = logging.getLogger('gp_ground_seg')
_warned_slow = False


class Backend(Protocol):
    """One method per stage; theta (T,) are the hyper-parameters of the frame.

    Each takes the values of the stages before and returns new ones.
    """

    @property
    def name(self) -> str:
        """``numba`` or ``numpy``."""

    def build_grid(self, xyz: PointArray, config: Config) -> Scan:
        """See `gp_ground_seg.core.pipeline.polar_grid.build_scan`."""

    def fit_plane(
        self, candidates: Candidates, max_slope: float, origin: Direction
    ) -> ground_plane.GroundPlane | None:
        """See `gp_ground_seg.core.pipeline.ground_plane.fit_plane`."""

    def is_wet(self, candidates: Candidates, plane_z: float, sensor_z: float) -> bool:
        """See `gp_ground_seg.core.pipeline.mirror_images.is_wet`."""

    def find_faces(self, scan: Scan, config: Config) -> Faces:
        """See `gp_ground_seg.core.pipeline.vertical_faces.find_faces`."""

    def find_relief(
        self, candidates: Candidates, faces: Faces, height: float, config: Config
    ) -> tuple[Relief, Candidates]:
        """See `gp_ground_seg.core.pipeline.relief.find_relief`."""

    def extract_lines(
        self, candidates: Candidates, faces: Faces, config: Config
    ) -> tuple[Candidates, Lines, PseudoInputs, BoolArray, BoolArray]:
        """See `gp_ground_seg.core.pipeline.lines.find_lines`."""

    def learn_frame(self, frame: Frame, config: Config) -> Learned:
        """See `gp_ground_seg.core.gp.learning.learn_frame`."""

    def estimate_surface(
        self, frame: Frame, theta: FloatArray, config: Config
    ) -> tuple[GroundSurface, FloatArray, FloatArray]:
        """See `gp_ground_seg.core.gp.ground.estimate_surface`."""

    def label_points(
        self, scan: Scan, faces: Faces, surface: GroundSurface, relief: Relief, config: Config
    ) -> Labelled:
        """See `gp_ground_seg.core.pipeline.labels.label_points`."""


class NumpyBackend:
    """Plain numpy."""

    name = 'numpy'
    build_grid = staticmethod(polar_grid.build_scan)
    fit_plane = staticmethod(ground_plane.fit_plane)
    is_wet = staticmethod(mirror_images.is_wet)
    find_faces = staticmethod(vertical_faces.find_faces)
    find_relief = staticmethod(relief.find_relief)
    extract_lines = staticmethod(lines.find_lines)
    learn_frame = staticmethod(learning.learn_frame)
    estimate_surface = staticmethod(ground.estimate_surface)
    label_points = staticmethod(labels.label_points)


def choose_backend(wanted: str) -> str:
    """Return ``numba`` or ``numpy`` for the parameter ``runtime.backend``.

    Raises
    ------
    MissingDependencyError
        If numba is asked for by name and not installed.
    """
    if wanted == 'numba' and not HAVE_NUMBA:
        raise MissingDependencyError(
            f'runtime.backend = numba, but numba is not installed: {install_hint("numba")}; '
            'or set runtime.backend to auto'
        )
    if wanted == 'auto' and not HAVE_NUMBA:
        _warn_slow('is not installed', install_hint('numba'))
    return 'numba' if HAVE_NUMBA and wanted != 'numpy' else 'numpy'


def make_backend(runtime: RuntimeConfig) -> Backend:
    """Backend for the parameters ``runtime``; raises as `choose_backend`."""
    if choose_backend(runtime.backend) == 'numpy':
        return NumpyBackend()
    try:
        # Imported only where it is used, as it imports numba.
        from gp_ground_seg.core.compiled.backend import NumbaBackend
    except Exception as error:  # of many types: a numba that does not fit this numpy, or coverage
        if runtime.backend == 'numba':
            raise MissingDependencyError(f'runtime.backend = numba: {error}') from error
        _warn_slow('cannot be imported', error)
        return NumpyBackend()
    return NumbaBackend()


def _warn_slow(reason: str, more: object) -> None:
    """Say once that numba is missing."""
    global _warned_slow
    if not _warned_slow:
        _warned_slow = True
        _LOGGER.warning('numba %s: using numpy, several times slower (%s)', reason, more)
