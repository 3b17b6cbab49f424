"""The numerics of a frame in plain numpy, one thread."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.blas import single_threaded_blas
from gp_ground_seg.config import FacesConfig, GridConfig, LabelConfig
from gp_ground_seg.faces import BegunFaces, Faces, find_faces
from gp_ground_seg.gp.batched import grow_surface_batched, latent_rows_batched
from gp_ground_seg.gp.batched_objective import objective_batched
from gp_ground_seg.gp.growth import BoolArray, GrowthTask
from gp_ground_seg.gp.objective import TrainingFrame
from gp_ground_seg.labelling import Labelled, label_points, local_roughness
from gp_ground_seg.points import in_columns
from gp_ground_seg.polar_grid import (
    Candidates,
    CellTables,
    FloatArray,
    IntArray,
    PointArray,
    PolarGrid,
    build_polar_grid,
    ground_candidates,
    reduce_cells,
)
from gp_ground_seg.pseudo_inputs import PseudoInputs
from gp_ground_seg.surface import GroundSurface, fuse_neighbours
from gp_ground_seg.tiles import Tiles, build_tiles
from gp_ground_seg.workspace import Workspace


class NumpyBackend:
    """See `gp_ground_seg.gp.backend.Backend`."""

    name = 'numpy'
    n_threads = 1

    def sort_points(
        self, xyz: PointArray, grid: GridConfig, tile_size: float, workspace: Workspace
    ) -> tuple[PointArray, PolarGrid, CellTables, Tiles]:
        """Cell and tile of each point, extremes of each."""
        xyz = in_columns(xyz, workspace)
        cells = build_polar_grid(xyz, grid)
        tiles = build_tiles(xyz, cells, tile_size)
        return xyz, cells, reduce_cells(cells, xyz[:, 2], tiles.tile), tiles

    def ground_candidates(
        self, cells: CellTables, edges: FloatArray, min_extent: float
    ) -> Candidates:
        """Lowest point and vertical density of each occupied bin."""
        return ground_candidates(cells, edges, min_extent)

    def begin_faces(
        self, xyz: PointArray, tiles: Tiles, faces: FacesConfig, max_height: float
    ) -> BegunFaces:
        """Upright faces, when they are asked for."""
        return BegunFaces(lambda: find_faces(xyz, tiles, faces, max_height), lambda: None)

    def label_points(
        self,
        xyz: PointArray,
        grid: PolarGrid,
        surface: GroundSurface,
        faces: Faces,
        label: LabelConfig,
        face_tolerance: float,
    ) -> Labelled:
        """Height, label and margin of each point; roughness of each bin."""
        z = xyz[:, 2].astype(np.float64)
        height = z - surface.at(grid)[0]
        roughness = local_roughness(height, grid, faces, label.obstacle_min_height)
        labels, margin = label_points(z, height, grid, faces, roughness, label, face_tolerance)
        return Labelled(labels, height, margin, roughness)

    @single_threaded_blas()
    def grow(
        self, task: GrowthTask, log_length_scale: FloatArray, knot_log_length_scale: FloatArray
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Inliers, mean and standard deviation of the surface."""
        return grow_surface_batched(
            task.candidates.offsets,
            task.candidates.r,
            task.height,
            np.exp(log_length_scale),
            task.seed,
            task.follows,
            task.knots,
            np.exp(knot_log_length_scale),
            np.exp(task.theta[:, 0]),
            np.exp(task.theta[:, 1]),
            task.gate_noise,
            task.slope_std,
            task.growth,
        )

    @single_threaded_blas()
    def grow_on_latent(
        self, task: GrowthTask, pseudo: PseudoInputs, n_knots: IntArray
    ) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
        """Both processes; the log length-scales at the knots as well."""
        u, knot_u = latent_rows_batched(
            task.theta,
            pseudo.offsets,
            pseudo.r_bar,
            pseudo.surface_class,
            task.candidates.offsets,
            task.candidates.r,
            task.knots,
            n_knots,
        )
        return *self.grow(task, u, knot_u), knot_u

    def fuse_neighbours(
        self,
        mean: FloatArray,
        std: FloatArray,
        knots: FloatArray,
        n_neighbours: int,
        slope_std: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Surfaces fused with those of the segments beside."""
        return fuse_neighbours(mean, std, knots, n_neighbours, slope_std)

    @single_threaded_blas()
    def objective(
        self, theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """Whole-frame objective and gradient."""
        return objective_batched(theta, frame, slope_std, latent_terms)

    def close(self) -> None:
        """Nothing to end."""
