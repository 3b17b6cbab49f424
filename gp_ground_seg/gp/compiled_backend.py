"""The numerics of a frame in compiled code, in threads."""

from __future__ import annotations

import numpy as np

from gp_ground_seg import label_passes, point_passes
from gp_ground_seg.config import FacesConfig, GridConfig, LabelConfig
from gp_ground_seg.faces import FEWEST_RETURNS, BegunFaces, Faces
from gp_ground_seg.gp.growth import BoolArray, GrowthTask
from gp_ground_seg.gp.growth_compiled import grow_on_latent_compiled, grow_surface_compiled
from gp_ground_seg.gp.objective import TrainingFrame
from gp_ground_seg.gp.objective_compiled import objective_rows
from gp_ground_seg.labelling import Labelled
from gp_ground_seg.parallel import RowPool
from gp_ground_seg.points import as_read_only, flat_rows, in_columns
from gp_ground_seg.polar_grid import (
    Candidates,
    CellTables,
    FloatArray,
    IntArray,
    PointArray,
    PolarGrid,
)
from gp_ground_seg.pseudo_inputs import PseudoInputs
from gp_ground_seg.rulers import grid_rulers
from gp_ground_seg.surface import GroundSurface, fuse_rows
from gp_ground_seg.tiles import Tiles, tiles_per_side
from gp_ground_seg.workspace import Workspace


class CompiledBackend:
    """See `gp_ground_seg.gp.backend.Backend`; rows of segments are shared out over threads.

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

    def sort_points(
        self, xyz: PointArray, grid: GridConfig, tile_size: float, workspace: Workspace
    ) -> tuple[PointArray, PolarGrid, CellTables, Tiles]:
        """Cell and tile of each point, extremes of each."""
        n_points = len(xyz)
        flat, step = flat_rows(xyz)
        if step > 0:
            # Sorting puts them there, block by block.
            target = workspace.take('columns', (3, n_points), xyz.dtype)
            xyz = as_read_only(target.T)
        else:
            target = np.empty((3, 0), dtype=xyz.dtype)
            xyz = in_columns(xyz, workspace)
        edges, ranges, turns = grid_rulers(grid, xyz.dtype)
        n_sides = tiles_per_side(grid.r_max, tile_size)
        n_shares = self._pool.n_shares(n_points)
        n_cells, n_tiles = grid.n_segments * grid.n_bins, n_sides**2
        take = workspace.take
        cell, r = np.empty(n_points, dtype=np.int32), np.empty(n_points, dtype=xyz.dtype)
        tile = take('tile', (n_points,), np.int32)
        # One row more, for the points that are in none.
        extremes = take('cells', (n_shares, n_cells + 1, 3), xyz.dtype)
        numbers = take('numbers', (n_shares, n_cells + 1, 2), np.int32)
        tile_extremes = take('tiles', (n_shares, n_tiles + 1, 2), xyz.dtype)
        touched = take('touched', (n_shares, n_tiles + 2), np.int32)
        self._pool.run_shares(
            point_passes.sort_points,
            n_points,
            flat,
            step,
            target,
            xyz.T,
            ranges,
            turns,
            1.0 / tile_size,
            n_sides,
            cell,
            r,
            extremes,
            numbers,
            tile,
            tile_extremes,
            touched,
        )
        point_passes.merge_cells(extremes, numbers)
        point_passes.merge_tiles(tile_extremes, touched)
        shape = grid.n_segments, grid.n_bins, -1
        return (
            xyz,
            PolarGrid(cell, r, edges, grid.n_segments),
            CellTables(extremes[0, :-1].reshape(shape), numbers[0, :-1].reshape(shape)),
            Tiles(tile, tile_extremes[0, :-1], touched[0, 1 : 1 + touched[0, 0]]),
        )

    def ground_candidates(
        self, cells: CellTables, edges: FloatArray, min_extent: float
    ) -> Candidates:
        """Lowest point and vertical density of each occupied bin."""
        n_segments, n_bins, _ = cells.numbers.shape
        size = n_segments * n_bins
        offsets, own_bin = np.empty(n_segments + 1, np.int64), np.empty(size, np.int64)
        r, z, density = np.empty((3, size))
        tile = np.empty(size, dtype=np.int32)
        n = point_passes.collect_candidates(
            cells.extremes,
            cells.numbers,
            np.diff(edges),
            min_extent,
            offsets,
            r,
            z,
            own_bin,
            density,
            tile,
        )
        return Candidates(r[:n], z[:n], own_bin[:n], density[:n], offsets, tile[:n])

    def begin_faces(
        self, xyz: PointArray, tiles: Tiles, faces: FacesConfig, max_height: float
    ) -> BegunFaces:
        """Upright faces, in another thread if there is one.

        Shared out, each thread would look at all points: two need as long as one.
        """
        flags = self._workspace.take('faces', (2, len(tiles.extremes)), np.bool_)
        flags.fill(False)
        is_face, is_footless = flags
        # As much as could be needed: what is not used takes no memory.
        room = 2 * len(tiles.extremes)
        slots = self._workspace.take('slots', (room,), np.int32)
        sums = self._workspace.take('sums', (room, label_passes.N_COLUMNS), np.float64)
        begun = self._pool.begin(
            label_passes.judge_faces,
            xyz.T,
            tiles.tile,
            tiles.extremes,
            tiles.touched,
            faces.cell_size,
            faces.min_height,
            max_height,
            faces.max_normal_z,
            FEWEST_RETURNS,
            faces.tolerance,
            faces.max_foot_distance,
            faces.max_foot_density,
            slots,
            sums,
            is_face,
            is_footless,
        )

        def find() -> Faces:
            begun.finish()
            return Faces(tiles, is_face, is_footless)

        return BegunFaces(find, begun.drop)

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
        n_points, n_cells = len(xyz), grid.n_segments * grid.n_bins
        take = self._workspace.take
        # One row more, for the points of no cell.
        cell_pieces = take('pieces', (n_cells + 1, 2), np.float64)
        label_passes.level_and_slope(surface.knots, surface.mean, cell_pieces)
        height = np.empty(n_points)
        sums = take('squares', (self._pool.n_shares(n_points), n_cells + 1, 3), np.int64)
        self._pool.run_shares(
            label_passes.survey_heights,
            n_points,
            xyz.T,
            grid.cell,
            grid.r,
            faces.tiles.tile,
            faces.is_face,
            cell_pieces,
            float(surface.knots[0]),
            label.obstacle_min_height,
            label.obstacle_max_height,
            height,
            sums,
        )
        roughness = np.empty((grid.n_segments, grid.n_bins))
        own_band = take('band', (n_cells + 1,), np.float64)
        label_passes.bands(
            sums,
            label.ground_tolerance,
            label.roughness_gain,
            label.obstacle_tolerance,
            label.obstacle_roughness_gain,
            label.obstacle_min_height,
            roughness,
            own_band,
        )
        labels, margin = np.empty(n_points, dtype=np.uint8), np.empty(n_points)
        self._pool.run_points(
            label_passes.label_by_height,
            n_points,
            xyz.T,
            grid.cell,
            faces.tiles.tile,
            height,
            faces.is_face,
            faces.is_footless,
            faces.tiles.extremes,
            own_band,
            label.below_tolerance,
            face_tolerance,
            labels,
            margin,
        )
        return Labelled(labels, height, margin, roughness)

    def grow(
        self, task: GrowthTask, log_length_scale: FloatArray, knot_log_length_scale: FloatArray
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Inliers, mean and standard deviation of the surface."""
        candidates, shape = task.candidates, knot_log_length_scale.shape
        results = np.empty(len(candidates.r), np.bool_), np.empty(shape), np.empty(shape)
        self._pool.run(
            grow_surface_compiled,
            len(candidates.offsets) - 1,
            candidates.offsets,
            candidates.r,
            task.height,
            log_length_scale,
            task.seed,
            task.follows,
            task.knots,
            knot_log_length_scale,
            *_limits(task),
            *results,
        )
        return results

    def grow_on_latent(
        self, task: GrowthTask, pseudo: PseudoInputs, n_knots: IntArray
    ) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
        """Both processes; the log length-scales at the knots as well."""
        candidates, shape = task.candidates, (len(n_knots), len(task.knots))
        at_candidates, at_knots = np.empty(len(candidates.r)), np.empty(shape)
        results = np.empty(len(candidates.r), np.bool_), np.empty(shape), np.empty(shape)
        self._pool.run(
            grow_on_latent_compiled,
            len(n_knots),
            task.theta,
            pseudo.offsets,
            pseudo.r_bar,
            pseudo.surface_class,
            candidates.offsets,
            candidates.r,
            task.knots,
            n_knots,
            at_candidates,
            at_knots,
            task.height,
            task.seed,
            task.follows,
            *_limits(task),
            *results,
        )
        return *results, at_knots

    def fuse_neighbours(
        self,
        mean: FloatArray,
        std: FloatArray,
        knots: FloatArray,
        n_neighbours: int,
        slope_std: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Surfaces fused with those of the segments beside."""
        if n_neighbours == 0:
            return mean, std
        aside = slope_std * 2.0 * np.pi / len(mean) * knots
        fused = np.full_like(mean, np.nan), np.full_like(std, np.nan)
        # Waking another thread would take as long.
        fuse_rows(0, len(mean), 1, mean, std, aside, n_neighbours, *fused)
        return fused

    def objective(
        self, theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """Whole-frame objective and gradient."""
        values = np.empty(frame.n_segments)
        gradients = np.empty((frame.n_segments, len(theta)))
        self._pool.run(
            objective_rows,
            frame.n_segments,
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


def _limits(task: GrowthTask) -> tuple[FloatArray | float, ...]:
    """Return what the growth holds the candidates against, in the order of its parameters."""
    growth = task.growth
    return (
        np.exp(task.theta[:, 0]),
        np.exp(task.theta[:, 1]),
        task.gate_noise,
        task.slope_std,
        growth.max_std,
        growth.max_standardised_residual,
        growth.max_standardised_depth,
    )
