"""The numba backend: each stage as a few calls of compiled functions."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.compiled import (
    evidence,
    ground,
    ground_plane,
    labels,
    learning,
    lines,
    polar_grid,
)
from gp_ground_seg.core.compiled import latent as latent_
from gp_ground_seg.core.compiled import relief as relief_
from gp_ground_seg.core.compiled import roughness as roughness_
from gp_ground_seg.core.compiled import vertical_faces as faces_
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
    PolarGrid,
    PseudoInputs,
    Scan,
    Tiles,
)
from gp_ground_seg.core.gp.evidence import CLEARLY, ODDS, STEP, uses_neighbours_in
from gp_ground_seg.core.gp.latent import given_log_length_scales
from gp_ground_seg.core.gp.learning import Learned, given_theta, theta_space
from gp_ground_seg.core.gp.search import search_from
from gp_ground_seg.core.jit import announce_compiling, keep_code
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.number_tuples import numbers_of
from gp_ground_seg.core.pipeline.ground_plane import GroundPlane
from gp_ground_seg.core.pipeline.labels import depth_of_ground, lowest_of, sum_units
from gp_ground_seg.core.pipeline.lines import lines_through
from gp_ground_seg.core.pipeline.points import Direction, copy_points, points_in
from gp_ground_seg.core.pipeline.polar_grid import grid_geometry
from gp_ground_seg.core.pipeline.relief import Relief


class Buffers:
    """Arrays by name, as long as the largest frame so far needed.

    A new array of a megabyte costs as much as a pass over it: its pages are
    mapped and cleared one by one. What is taken from here must not outlive the frame.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, npt.NDArray[Any]] = {}
        self._views: dict[str, npt.NDArray[Any]] = {}
        self._tiles: polar_grid.TileTable | None = None

    def take(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """Array of that shape with arbitrary content, C-contiguous.

        Parameters
        ----------
        name : str
            One name, one purpose: a second call with it returns the same memory.
        shape : tuple of int
            Shape wanted.
        dtype : dtype
            Type of the elements.
        """
        view = self._views.get(name)
        if view is not None and view.shape == shape and view.dtype == dtype:
            return view
        size = math.prod(shape)
        held = self._arrays.get(name)
        if held is None or len(held) < size or held.dtype != np.dtype(dtype):
            held = self._arrays[name] = np.empty(size, dtype=dtype)
        view = self._views[name] = held[:size].reshape(shape)
        return view

    def tile_table(self, n_tiles: int, dtype: npt.DTypeLike) -> polar_grid.TileTable:
        """Table as the last scan left it, or a new one of the size wanted."""
        held = self._tiles
        if held is None or len(held.extremes) != n_tiles + 1 or held.extremes.dtype != dtype:
            held = self._tiles = polar_grid.TileTable.empty(n_tiles, dtype)
        return held


class NumbaBackend:
    """See `gp_ground_seg.core.backend.Backend`.

    A process that is forked while a thread of this one segments has half-filled buffers: it begins
    with new ones.
    """

    name = 'numba'

    def __init__(self) -> None:
        self._pid, self._buffers = os.getpid(), Buffers()

    def build_grid(self, xyz: PointArray, config: Config) -> Scan:
        """Sort points into cells and tiles; lowest point of each cell."""
        announce_compiling()
        if self._pid != os.getpid():
            self._pid, self._buffers = os.getpid(), Buffers()
        n_points, dtype, take = len(xyz), xyz.dtype, self._buffers.take
        geometry = grid_geometry(config.grid, config.faces.cell_size, dtype)
        n_segments, n_cells = config.grid.n_segments, config.grid.n_segments * config.grid.n_bins
        columns = take('columns', (3, n_points), dtype)
        cell, r = np.empty(n_points, dtype=np.int32), np.empty(n_points, dtype=dtype)
        tile = take('tile', (n_points,), np.int32)
        cells = polar_grid.CellTable(
            take('extremes', (n_cells + 1, 5), dtype),
            take('numbers', (n_cells + 1, 2), np.int32),
        )
        tiles = self._buffers.tile_table(geometry.n_sides**2, dtype)
        copy_points(xyz, columns)
        places = polar_grid.Places(cell, r, tile)
        polar_grid.sort_points(columns, geometry, places, cells, tiles)
        buffers = Candidates.buffers(n_cells, n_segments)
        min_extent = config.lines.min_density_extent
        n = polar_grid.take_candidates(cells, geometry.edges, min_extent, buffers)
        return Scan(
            points_in(columns),
            PolarGrid(cell, r, geometry.edges, n_segments),
            Tiles(tile, tiles.extremes[:-1], tiles.occupied[1 : 1 + tiles.occupied[0]]),
            buffers.first(n),
        )

    def fit_plane(
        self, candidates: Candidates, max_slope: float, origin: Direction
    ) -> GroundPlane | None:
        """Plane of the ground around the sensor."""
        return ground_plane.fit_plane(candidates, max_slope, origin)

    def find_faces(self, scan: Scan, config: Config) -> Faces:
        """Tiles that hold a vertical face."""
        take = self._buffers.take
        thresholds, heights = numbers_of(config.faces), numbers_of(config.label)
        n_tiles = len(scan.tiles.extremes)
        tile_to_row, row_to_tile = take('tile_rows', (2, n_tiles), np.int32)
        n_tall = faces_.select_tall(scan.tiles, heights, tile_to_row, row_to_tile)
        sums = take('face_sums', (2 * n_tall, faces_.N_COLUMNS), np.float64)
        buffers = faces_.FaceSums(tile_to_row, row_to_tile, sums)
        tile_size = thresholds.cell_size
        faces_.sum_returns(scan.xyz.T, scan.tiles, tile_size, heights, n_tall, buffers)
        result = Faces(*take('faces', (2, n_tiles), np.bool_))
        faces_.decide_faces(n_tall, thresholds, heights, buffers, result)
        return result

    def find_relief(
        self, candidates: Candidates, faces: Faces, height: float, config: Config
    ) -> tuple[Relief, Candidates]:
        """Relief of the land, and the candidates over it."""
        growth = numbers_of(config.growth)
        relief, z = Relief.level(), np.empty_like(candidates.z)
        if not config.surface.look_aside or relief_.find_relief(
            candidates, faces.is_face, height, growth, relief.pieces, z
        ):
            return relief, candidates
        return relief, candidates._replace(z=z)

    def extract_lines(
        self, candidates: Candidates, faces: Faces, config: Config
    ) -> tuple[Candidates, Lines, PseudoInputs, BoolArray, BoolArray]:
        """Candidates that show ground, lines, pseudo-inputs; which continue lines, which stand."""
        buffers = Candidates.buffers(len(candidates.r), len(candidates.offsets) - 1)
        kept = buffers.first(lines.keep_visible(candidates, faces.has_occluded_base, buffers))
        return kept, *lines_through(kept, config, lines.trace), faces.is_face[kept.tile]

    def learn_frame(self, frame: Frame, config: Config) -> Learned:
        """Hyper-parameters of the frame."""
        no_knots, space = frame._replace(knots=frame.knots[:0]), theta_space(config)
        u, knot_u = self._given_length_scales(no_knots, config)
        by_itself = self._surfaces(u, knot_u)
        theta, outcome = given_theta(config), np.empty(2)
        n = learning.learn_frame(
            no_knots,
            space,
            numbers_of(config.observation),
            numbers_of(config.growth),
            numbers_of(config.learning),
            config.learning.objective == 'map',
            config.length_scale.model == 'latent',
            ODDS if config.label.rule == 'roughness' else 0.0,
            by_itself,
            search_from(theta, space.lower.copy(), space.upper.copy()),
            theta,
            outcome,
        )
        return Learned.of(theta, float(outcome[0]), n, int(outcome[1]), space)

    def estimate_surface(
        self, frame: Frame, theta: FloatArray, config: Config
    ) -> tuple[GroundSurface, FloatArray, FloatArray]:
        """Inliers, the surface, and log length-scales at the knots and at the candidates."""
        take, knots, slope_std = self._buffers.take, frame.knots, config.observation.slope_std
        observation, growth = numbers_of(config.observation), numbers_of(config.growth)
        shape = (frame.candidates.n_segments, len(knots))
        u, knot_u = self._given_length_scales(frame, config)
        if config.length_scale.model == 'latent':
            latent_.latent_log_length_scales(frame, theta, 1, u, knot_u)
        by_itself = self._surfaces(u, knot_u)
        uses_neighbours = uses_neighbours_in(frame, config)
        max_slope = CLEARLY * slope_std if uses_neighbours else -1.0
        own_evidence, evidence_table = take('evidence', (2, 2, *shape), np.float64)
        odds = evidence.find_seeds(
            frame, theta, growth, max_slope, own_evidence[0], by_itself.seed
        )
        odds = odds if config.label.rule == 'roughness' else 0.0

        def grow(from_neighbours: FloatArray, step: int) -> None:
            ground.grow_surfaces(
                frame, theta, observation, growth, odds, from_neighbours, step, by_itself
            )

        def find_evidence() -> None:
            evidence.find_evidence(
                by_itself.mean,
                by_itself.std,
                theta,
                knots,
                slope_std,
                own_evidence,
                evidence_table,
            )

        from_neighbours = evidence_table if uses_neighbours else evidence_table[:, :0]
        if uses_neighbours:
            by_itself.mean.fill(np.nan)
            by_itself.std.fill(np.nan)
            grow(evidence_table[:, :0], STEP)
            find_evidence()
        grow(from_neighbours, 1)
        if uses_neighbours:
            find_evidence()
        mean, std = np.empty((2, *shape))
        evidence.combine(
            by_itself, from_neighbours, theta, knots, slope_std, frame.prior_mean, mean, std
        )
        return GroundSurface(knots, mean, std, by_itself.inlier), knot_u, u

    def _given_length_scales(self, frame: Frame, config: Config) -> tuple[FloatArray, FloatArray]:
        """Log length-scales at the candidates and at the knots, to be set if they are latent."""
        if config.length_scale.model != 'latent':
            return given_log_length_scales(frame, config.length_scale)
        u = self._buffers.take('u', (len(frame.candidates.r),), np.float64)
        return u, np.empty((frame.candidates.n_segments, len(frame.knots)))

    def _surfaces(self, u: FloatArray, knot_u: FloatArray) -> ground.SegmentSurfaces:
        """Surfaces to be set, with these log length-scales."""
        return ground.SegmentSurfaces(
            u,
            knot_u,
            self._buffers.take('seed', u.shape, np.bool_),
            np.empty(u.shape, np.bool_),
            *self._buffers.take('surfaces', (2, *knot_u.shape), np.float64),
        )

    def label_points(
        self, scan: Scan, faces: Faces, surface: GroundSurface, relief: Relief, config: Config
    ) -> Labelled:
        """Height, label and margin of each point."""
        take, label = self._buffers.take, numbers_of(config.label)
        n_points, n_tiles = len(scan.xyz), len(faces.is_face)
        by_roughness, units = config.label.rule == 'roughness', sum_units(n_points)
        pieces = take('pieces', (scan.grid.n_segments * scan.grid.n_bins + 1, 2), np.float64)
        sums = take('height_sums', (n_tiles + 1, 2), np.int64)
        blocks = take('block_rows', ((math.isqrt(n_tiles) + 2) ** 2,), np.int32)
        counts = take('counts', (roughness_.N_WORDS * (len(scan.tiles.occupied) + 1),), np.uint64)
        roughness = take('roughness', (n_tiles + 1,), np.float64)
        result = Labelled(np.empty(n_points, np.uint8), np.empty(n_points), np.empty(n_points))
        labels.fit_pieces(surface, pieces)
        labels.survey(
            scan, faces.is_face, pieces, relief, relief.is_level, units, result.height, sums
        )
        if by_roughness:
            roughness_.set_roughness(scan.tiles, sums, units, blocks, counts, roughness)
        else:
            roughness.fill(0.0)  # no band is higher than the tolerance
        depth, has_obstacle = depth_of_ground(config.label), take('has_obstacle', (n_tiles,), bool)
        has_obstacle.fill(False)
        labels.label_by_bands(scan, faces, label, depth, roughness, has_obstacle, result)
        if by_roughness:
            votes = labels.VoteBuffers(
                take('rows', (n_tiles + 1,), np.int32),
                *take('voters', (2, n_points), np.int32),
            )
            labels.vote(scan, lowest_of(surface), has_obstacle, label, votes, result)
        keep_code()
        return result
