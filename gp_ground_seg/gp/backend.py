"""Who computes a frame: plain numpy, or compiled code in threads."""

from __future__ import annotations

import logging
from typing import Protocol

from gp_ground_seg.compiled import HAVE_NUMBA
from gp_ground_seg.config import FacesConfig, GridConfig, LabelConfig, RuntimeConfig
from gp_ground_seg.errors import MissingDependencyError
from gp_ground_seg.faces import BegunFaces, Faces
from gp_ground_seg.gp.growth import BoolArray, GrowthTask
from gp_ground_seg.gp.objective import TrainingFrame
from gp_ground_seg.labelling import Labelled
from gp_ground_seg.polar_grid import (
    Candidates,
    CellTables,
    FloatArray,
    IntArray,
    PointArray,
    PolarGrid,
)
from gp_ground_seg.pseudo_inputs import PseudoInputs
from gp_ground_seg.surface import GroundSurface
from gp_ground_seg.tiles import Tiles
from gp_ground_seg.workspace import Workspace

_LOGGER = logging.getLogger('gp_ground_seg')
_said_slow = False


class Backend(Protocol):
    """What the segmenter asks of a backend; theta has one row per segment."""

    name: str
    n_threads: int

    def sort_points(
        self, xyz: PointArray, grid: GridConfig, tile_size: float, workspace: Workspace
    ) -> tuple[PointArray, PolarGrid, CellTables, Tiles]:
        """See `build_polar_grid` and `reduce_cells`; `gp_ground_seg.tiles.build_tiles`.

        First the points as `gp_ground_seg.points.in_columns` puts them. All but the grid
        may lie in `workspace`.
        """

    def ground_candidates(
        self, cells: CellTables, edges: FloatArray, min_extent: float
    ) -> Candidates:
        """See `gp_ground_seg.polar_grid.ground_candidates`."""

    def begin_faces(
        self, xyz: PointArray, tiles: Tiles, faces: FacesConfig, max_height: float
    ) -> BegunFaces:
        """Begin `gp_ground_seg.faces.find_faces`, in another thread if there is one.

        They, or that they are dropped, are to be waited for before the points change.
        """

    def label_points(
        self,
        xyz: PointArray,
        grid: PolarGrid,
        surface: GroundSurface,
        faces: Faces,
        label: LabelConfig,
        face_tolerance: float,
    ) -> Labelled:
        """See `gp_ground_seg.labelling`."""

    def grow(
        self, task: GrowthTask, log_length_scale: FloatArray, knot_log_length_scale: FloatArray
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """See `gp_ground_seg.gp.growth.grow_surface_reference`; log length-scales (C,), (M, K)."""

    def grow_on_latent(
        self, task: GrowthTask, pseudo: PseudoInputs, n_knots: IntArray
    ) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
        """Both processes: `gp_ground_seg.gp.latent.latent_rows_reference`, then `grow`.

        What `grow` gives, and the log length-scales at the knots (M, K) [log m].
        """

    def fuse_neighbours(
        self,
        mean: FloatArray,
        std: FloatArray,
        knots: FloatArray,
        n_neighbours: int,
        slope_std: float,
    ) -> tuple[FloatArray, FloatArray]:
        """See `gp_ground_seg.surface.fuse_neighbours`."""

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
    from gp_ground_seg.gp.compiled_backend import CompiledBackend

    return CompiledBackend(runtime.n_threads)
