"""The numerics of a frame in compiled code, in threads."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from gp_ground_seg.compiled.face_passes import N_COLUMNS, judge_faces
from gp_ground_seg.compiled.growth_compiled import estimate_surface
from gp_ground_seg.compiled.label_passes import label_scan
from gp_ground_seg.compiled.line_passes import find_lines_compiled
from gp_ground_seg.compiled.meeting import Board, make_board
from gp_ground_seg.compiled.objective_compiled import objective_rows
from gp_ground_seg.compiled.parallel import MOST_STAGES, RowPool, Team
from gp_ground_seg.compiled.point_passes import UNKNOWN, collect_candidates, sort_points
from gp_ground_seg.compiled.rulers import grid_rulers
from gp_ground_seg.compiled.workspace import Workspace
from gp_ground_seg.frame import (
    BoolArray,
    Candidates,
    CellArray,
    Faces,
    FloatArray,
    GroundSurface,
    Labelled,
    Lines,
    PointArray,
    PolarGrid,
    PseudoInputs,
    Tiles,
)
from gp_ground_seg.gp.growth import GrowthTask
from gp_ground_seg.gp.objective import TrainingFrame
from gp_ground_seg.parameters.config import Config, GridConfig
from gp_ground_seg.pipeline.labelling import LabelTask
from gp_ground_seg.pipeline.points import as_read_only, flat_rows, in_columns
from gp_ground_seg.pipeline.sorted_points import SortedPoints
from gp_ground_seg.pipeline.tiles import tiles_per_side


@dataclass(frozen=True)
class _BegunLabels:
    """Labels that other threads have gone on to, by the surface of that `mean`."""

    task: LabelTask
    mean: FloatArray
    team: Team
    labelled: Labelled


class CompiledBackend:
    """See `gp_ground_seg.backend.Backend`; rows of segments are shared out over threads.

    Parameters
    ----------
    n_threads : int
        Number of threads; 0 = all cores.
    """

    name = 'numba'

    def __init__(self, n_threads: int) -> None:
        self._pool = RowPool(n_threads)
        self.n_threads = self._pool.n_threads
        self._workspace = Workspace()
        self._begun: _BegunLabels | None = None
        self._tables: tuple[PointArray, CellArray] | None = None

    def sort_points(
        self, xyz: PointArray, config: Config, workspace: Workspace, seeks_faces: bool = True
    ) -> SortedPoints:
        """Cell and tile of each point, candidates; other threads go on to look for faces."""
        grid, faces = config.grid, config.faces
        n_points = len(xyz)
        flat, step = flat_rows(xyz)
        if step > 0:
            # Sorting puts them there, block by block.
            target = workspace.take('columns', (3, n_points), xyz.dtype)
            xyz = as_read_only(target.T)
        else:
            target = np.empty((3, 0), dtype=xyz.dtype)
            xyz = in_columns(xyz, workspace)
        columns = xyz.T
        edges, ranges, turns = grid_rulers(grid, xyz.dtype)
        n_sides = tiles_per_side(grid.r_max, faces.cell_size)
        # Who asks for no faces may do so while others still look for those of another scan.
        n_shares = self._pool.n_shares(n_points) if seeks_faces else 1
        n_cells, n_tiles = grid.n_segments * grid.n_bins, n_sides**2
        take = workspace.take
        cell, r = np.empty(n_points, dtype=np.int32), np.empty(n_points, dtype=xyz.dtype)
        tile = take('tile', (n_points,), np.int32)
        # One row more, for the points that are in none.
        extremes = take('cells', (n_shares, n_cells + 1, 3), xyz.dtype)
        numbers = take('numbers', (n_shares, n_cells + 1, 2), np.int32)
        tile_extremes = take('tiles', (n_shares, n_tiles + 1, 2), xyz.dtype)
        touched = take('touched', (n_shares, n_tiles + 2), np.int32)
        if not (seeks_faces and self._takes_back(tile_extremes, touched)):
            touched[:, 0] = UNKNOWN
        is_face, is_footless = take('faces', (2, n_tiles), np.bool_)
        # As much as could be needed: what is not used takes no memory.
        room = 2 * n_tiles if seeks_faces else 0
        slots = take('slots', (room + 1,), np.int32)
        sums = take('sums', (n_shares, room, N_COLUMNS), np.float64)
        team = self._pool.team(n_shares) if seeks_faces else Team(make_board(MOST_STAGES, 1), 1)

        sorting = (
            flat,
            step,
            target,
            columns,
            ranges,
            turns,
            1.0 / faces.cell_size,
            n_sides,
            cell,
            r,
            extremes,
            numbers,
            tile,
            tile_extremes,
            touched,
        )
        if seeks_faces:
            judging = (
                columns,
                tile,
                tile_extremes,
                touched,
                faces.cell_size,
                faces.min_height,
                config.label.obstacle_max_height,
                faces.max_normal_z,
                faces.tolerance,
                faces.max_foot_distance,
                faces.max_foot_density,
                slots,
                sums,
                is_face,
                is_footless,
            )
            team.begin(sort_points, sorting, judge_faces, judging)
            self._tables = tile_extremes, touched
        else:
            team.run(sort_points, *sorting)

        @cache
        def find() -> Faces:
            if not team.finish():
                raise RuntimeError('faces are wanted that were dropped')
            tiles = Tiles(tile, tile_extremes[0, :-1], touched[0, 1 : 1 + touched[0, 0]])
            return Faces(tiles, is_face, is_footless)

        candidates = _collect_candidates(
            team.board, extremes, numbers, grid, edges, config.lines.min_density_extent
        )
        return SortedPoints(
            xyz, PolarGrid(cell, r, edges, grid.n_segments), candidates, find, team.dismiss
        )

    def _takes_back(self, tile_extremes: PointArray, touched: CellArray) -> bool:
        """Tell whether these tables of tiles are as the scan before left them.

        They count as lost until the next one is sorted, too.
        """
        left, self._tables = self._tables, None
        return left is not None and left[0] is tile_extremes and left[1] is touched

    def find_lines(
        self, candidates: Candidates, is_footless: BoolArray, config: Config
    ) -> tuple[Candidates, Lines, PseudoInputs, BoolArray]:
        """Candidates that show ground, lines through them, pseudo-inputs, and who follows whom."""
        return find_lines_compiled(candidates, is_footless, config)

    def label_points(self, task: LabelTask, surface: GroundSurface) -> Labelled:
        """Height, label and margin of each point; roughness of each bin."""
        begun, self._begun = self._begun, None
        if (
            begun is not None
            and begun.task is task
            and begun.mean is surface.mean
            # Not so if the threads were called for something else in between.
            and begun.team.finish()
        ):
            return begun.labelled
        labelled, arguments = self._to_label(task, surface.knots, surface.mean)
        self._pool.run(label_scan, self._pool.n_shares(len(task.xyz)), *arguments)
        return labelled

    def _to_label(
        self, task: LabelTask, knots: FloatArray, mean: FloatArray
    ) -> tuple[Labelled, tuple[Any, ...]]:
        """Room for the result, and the arguments of `label_scan`."""
        xyz, grid, faces, label = task.xyz, task.grid, task.faces, task.label
        n_points, n_cells = len(xyz), grid.n_segments * grid.n_bins
        take = self._workspace.take
        # One row more, for the points of no cell.
        pieces = take('pieces', (n_cells + 1, 2), np.float64)
        sums = take('squares', (self._pool.n_shares(n_points), n_cells + 1, 2), np.int64)
        own_band = take('band', (n_cells + 1,), np.float64)
        height, margin = np.empty(n_points), np.empty(n_points)
        labels = np.empty(n_points, dtype=np.uint8)
        roughness = np.empty((grid.n_segments, grid.n_bins))
        arguments = (
            xyz.T,
            grid.cell,
            grid.r,
            faces.tiles.tile,
            faces.tiles.extremes,
            faces.is_face,
            faces.is_footless,
            knots,
            mean,
            label.ground_tolerance,
            label.roughness_gain,
            label.obstacle_tolerance,
            label.obstacle_roughness_gain,
            label.obstacle_min_height,
            label.obstacle_max_height,
            label.below_tolerance,
            task.face_tolerance,
            pieces,
            sums,
            own_band,
            height,
            roughness,
            labels,
            margin,
        )
        return Labelled(labels, height, margin, roughness), arguments

    def grow(
        self,
        task: GrowthTask,
        log_length_scale: FloatArray,
        knot_log_length_scale: FloatArray,
        to_label: LabelTask | None = None,
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Inliers, mean and standard deviation of the fused surface."""
        given = log_length_scale, knot_log_length_scale
        return self._estimate_surface(task, None, *given, to_label)

    def grow_on_latent(
        self, task: GrowthTask, pseudo: PseudoInputs, to_label: LabelTask | None = None
    ) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
        """Both processes; the log length-scales at the knots as well."""
        u = self._workspace.take('u', (len(task.candidates.r),), np.float64)
        knot_u = np.empty((len(task.theta), len(task.knots)))
        return *self._estimate_surface(task, pseudo, u, knot_u, to_label), knot_u

    def _estimate_surface(
        self,
        task: GrowthTask,
        pseudo: PseudoInputs | None,
        log_length_scale: FloatArray,
        knot_log_length_scale: FloatArray,
        to_label: LabelTask | None,
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        is_latent = pseudo is not None
        if pseudo is None:
            nothing = np.empty(0), np.empty(0, np.int64), np.empty(0, np.int64)
            pseudo = PseudoInputs(*nothing, np.empty(0))
        candidates, growth, shape = task.candidates, task.growth, knot_log_length_scale.shape
        size, take = len(candidates.r), self._workspace.take
        mean, std, inlier = np.empty(shape), np.empty(shape), np.empty(size, np.bool_)
        arguments = (
            is_latent,
            task.theta,
            pseudo.offsets,
            pseudo.r_bar,
            pseudo.surface_class,
            candidates.offsets,
            candidates.bin,
            candidates.r,
            candidates.z,
            task.prior_mean,
            log_length_scale,
            task.follows,
            task.knots,
            knot_log_length_scale,
            task.observation.sigma_n,
            task.observation.slope_std,
            growth.seed_range,
            growth.seed_height_tolerance,
            task.segment_step,
            growth.max_std,
            growth.max_standardised_residual,
            growth.max_standardised_depth,
            task.n_neighbours,
            take('n_knots', (shape[0],), np.int64),
            take('scales', (3, shape[0]), np.float64),
            take('height', (size,), np.float64),
            take('is_seed', (size,), np.bool_),
            take('own_surface', (2, *shape), np.float64),
            inlier,
            mean,
            std,
        )
        if to_label is None:
            self._pool.run(estimate_surface, self.n_threads, *arguments)
        else:
            labelled, labelling = self._to_label(to_label, task.knots, mean)
            team = self._pool.team(self._pool.n_shares(len(to_label.xyz)))
            team.begin(estimate_surface, arguments, label_scan, labelling)
            self._begun = _BegunLabels(to_label, mean, team, labelled)
        return inlier, mean, std

    def objective(
        self, theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """Whole-frame objective and gradient."""
        values = np.empty(frame.n_segments)
        gradients = np.empty((frame.n_segments, len(theta)))
        self._pool.run(
            objective_rows,
            self.n_threads,
            theta,
            frame.offsets,
            frame.r,
            frame.z,
            frame.log_length_scale,
            frame.bar_offsets,
            frame.r_bar,
            frame.surface_class,
            slope_std,
            latent_terms,
            values,
            gradients,
        )
        value = float(values.sum())
        if not np.isfinite(value):
            return -np.inf, np.zeros(len(theta))
        return value, gradients.sum(axis=0)

    def close(self) -> None:
        """End the threads."""
        self._pool.close()


def _collect_candidates(
    board: Board,
    extremes: PointArray,
    numbers: CellArray,
    grid: GridConfig,
    edges: FloatArray,
    min_extent: float,
) -> Candidates:
    """Lowest point and vertical density of each occupied bin."""
    size = grid.n_segments * grid.n_bins
    offsets, own_bin = np.empty(grid.n_segments + 1, np.int64), np.empty(size, np.int64)
    r, z, density = np.empty((3, size))
    tile = np.empty(size, dtype=np.int32)
    n = collect_candidates(
        board, extremes, numbers, np.diff(edges), min_extent, offsets, r, z, own_bin, density, tile
    )
    return Candidates(r[:n], z[:n], own_bin[:n], density[:n], offsets, tile[:n])
