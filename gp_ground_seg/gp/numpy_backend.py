"""The numerics of a frame in plain numpy, one thread."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.compiled.workspace import Workspace
from gp_ground_seg.frame import (
    BoolArray,
    Candidates,
    Faces,
    FloatArray,
    GroundSurface,
    Labelled,
    Lines,
    PointArray,
    PseudoInputs,
)
from gp_ground_seg.gp.batched import grow_surface_batched, latent_rows_batched
from gp_ground_seg.gp.batched_objective import objective_batched
from gp_ground_seg.gp.blas import single_threaded_blas
from gp_ground_seg.gp.growth import GrowthTask
from gp_ground_seg.gp.objective import TrainingFrame
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.pipeline.faces import find_faces
from gp_ground_seg.pipeline.hidden_feet import without_hidden_feet
from gp_ground_seg.pipeline.labelling import LabelTask, label_points, local_roughness
from gp_ground_seg.pipeline.line_bends import candidates_that_follow
from gp_ground_seg.pipeline.line_extraction import extract_lines
from gp_ground_seg.pipeline.points import in_columns
from gp_ground_seg.pipeline.polar_grid import build_polar_grid, ground_candidates, reduce_cells
from gp_ground_seg.pipeline.pseudo_inputs import select_pseudo_inputs
from gp_ground_seg.pipeline.sorted_points import SortedPoints
from gp_ground_seg.pipeline.surface import fuse_neighbours
from gp_ground_seg.pipeline.tiles import build_tiles


class NumpyBackend:
    """See `gp_ground_seg.backend.Backend`."""

    name = 'numpy'
    n_threads = 1

    def sort_points(
        self, xyz: PointArray, config: Config, workspace: Workspace, seeks_faces: bool = True
    ) -> SortedPoints:
        """Cell and tile of each point, candidates; faces when they are asked for."""
        xyz = in_columns(xyz, workspace)
        grid = build_polar_grid(xyz, config.grid)
        tiles = build_tiles(xyz, grid, config.faces.cell_size)
        cells = reduce_cells(grid, xyz[:, 2], tiles.tile)
        candidates = ground_candidates(cells, grid.edges, config.lines.min_density_extent)

        def find() -> Faces:
            return find_faces(xyz, tiles, config.faces, config.label.obstacle_max_height)

        return SortedPoints(xyz, grid, candidates, find, lambda: None)

    def find_lines(
        self, candidates: Candidates, is_footless: BoolArray, config: Config
    ) -> tuple[Candidates, Lines, PseudoInputs, BoolArray]:
        """Candidates that show ground, lines through them, pseudo-inputs, and who follows whom."""
        kept = without_hidden_feet(candidates, is_footless)
        lines = extract_lines(kept, config.lines)
        pseudo = select_pseudo_inputs(kept, lines, config)
        return kept, lines, pseudo, candidates_that_follow(lines, kept, config)

    @single_threaded_blas()
    def grow(
        self,
        task: GrowthTask,
        log_length_scale: FloatArray,
        knot_log_length_scale: FloatArray,
        to_label: LabelTask | None = None,
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Inliers, mean and standard deviation of the fused surface."""
        inlier, mean, std = grow_surface_batched(
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
            task.observation.slope_std,
            task.growth,
        )
        mean, std = fuse_neighbours(
            mean, std, task.knots, task.n_neighbours, task.observation.slope_std
        )
        return inlier, mean + task.prior_mean, std

    @single_threaded_blas()
    def grow_on_latent(
        self, task: GrowthTask, pseudo: PseudoInputs, to_label: LabelTask | None = None
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
            task.n_knots,
        )
        return *self.grow(task, u, knot_u), knot_u

    def label_points(self, task: LabelTask, surface: GroundSurface) -> Labelled:
        """Height, label and margin of each point; roughness of each bin."""
        z, grid, faces = task.xyz[:, 2].astype(np.float64), task.grid, task.faces
        height = z - surface.at(grid)[0]
        roughness = local_roughness(height, grid, faces, task.label.obstacle_min_height)
        labels, margin = label_points(
            z, height, grid, faces, roughness, task.label, task.face_tolerance
        )
        return Labelled(labels, height, margin, roughness)

    @single_threaded_blas()
    def objective(
        self, theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """Whole-frame objective and gradient."""
        return objective_batched(theta, frame, slope_std, latent_terms)

    def close(self) -> None:
        """Nothing to end."""
