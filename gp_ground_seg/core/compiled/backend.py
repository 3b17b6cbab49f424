"""The numba backend: each stage as a few calls of compiled functions."""

from functools import partial

import numpy as np

from gp_ground_seg.core.compiled import ground_plane, labels, polar_grid
from gp_ground_seg.core.compiled import relief as relief_
from gp_ground_seg.core.compiled import vertical_faces as faces_
from gp_ground_seg.core.frame import (
    OUTSIDE,
    Candidates,
    Faces,
    GroundSurface,
    Labelled,
    PointArray,
    PolarGrid,
    Scan,
    Tiles,
    linear_pieces,
)
from gp_ground_seg.core.gp.ground import estimate_surface, fit_surfaces
from gp_ground_seg.core.gp.learning import fit_theta, learn_frame
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import numbers_of
from gp_ground_seg.core.pipeline.ground_plane import find_planes
from gp_ground_seg.core.pipeline.labels import (
    highest_ground,
    lowest_of,
    number_shift,
    sum_units,
)
from gp_ground_seg.core.pipeline.lines import find_lines, trace
from gp_ground_seg.core.pipeline.points import in_columns
from gp_ground_seg.core.pipeline.polar_grid import grid_geometry
from gp_ground_seg.core.pipeline.relief import Relief
from gp_ground_seg.core.pipeline.terrain import with_standing


class NumbaBackend:
    """The stages of `gp_ground_seg.core.backend.NumpyBackend`, compiled."""

    name = 'numba'
    find_planes = staticmethod(partial(find_planes, fit=ground_plane.fit))
    extract_lines = staticmethod(partial(find_lines, trace_lines=jit(entry=True)(trace)))
    learn_frame = staticmethod(partial(learn_frame, fit=jit(entry=True)(fit_theta)))
    estimate_surface = staticmethod(partial(estimate_surface, fit=jit(entry=True)(fit_surfaces)))

    def build_grid(self, xyz: PointArray, config: Config) -> Scan:
        """Sort points into cells and tiles; lowest point of each cell."""
        xyz, n_points, dtype = in_columns(xyz), len(xyz), xyz.dtype
        geometry = grid_geometry(config.grid, config.faces.cell_size, dtype)
        n_segments, n_bins = config.grid.n_segments, len(geometry.edges) - 1
        cell, tile = np.empty(n_points, np.int32), np.empty(n_points, np.int32)
        grid = PolarGrid(cell, np.empty(n_points, dtype), geometry.edges, n_segments)
        at = np.full(geometry.n_sides**2, OUTSIDE, np.int32)
        n = min(n_points, len(at))
        tiles = Tiles(tile, np.empty((n, 2), dtype), np.empty(n, np.int32), at)
        candidates = Candidates.buffers(n_segments * n_bins, n_segments)
        extent, least = np.empty(n_segments * n_bins), config.lines.min_density_extent
        n, count = polar_grid.build_grid(xyz.T, geometry, least, grid, tiles, candidates, extent)
        tiles = tiles._replace(extremes=tiles.extremes[:n], place=tiles.place[:n])
        return Scan(xyz, grid, tiles, candidates.first(count), extent)

    def find_faces(self, scan: Scan, height: float, config: Config) -> Faces:
        """Tiles that show no ground."""
        result = Faces.none(scan.tiles)
        groups = numbers_of(config.faces), numbers_of(config.label)
        faces_.find_faces(scan._replace(xyz=scan.xyz.T), height, *groups, result)
        return result

    def find_relief(
        self, candidates: Candidates, faces: Faces, height: float, config: Config
    ) -> tuple[Relief, Candidates, Faces]:
        """Relief of the terrain, the candidates over it, and faces with what stands on it."""
        relief, z = Relief.level(), np.empty_like(candidates.z)
        if not config.surface.look_aside:
            return relief, candidates, faces
        growth, stands = numbers_of(config.growth), np.zeros(len(z), dtype=np.bool_)
        relief_.find_relief(candidates, faces, height, growth, relief.pieces, z, stands)
        over = candidates if relief.is_level else candidates._replace(z=z)
        return relief, over, with_standing(faces, candidates.tile, stands)

    def label_points(
        self,
        scan: Scan,
        faces: Faces,
        surface: GroundSurface,
        relief: Relief,
        height: float,
        config: Config,
    ) -> Labelled:
        """Height, label and margin of each point."""
        n_points = len(scan.xyz)
        numbers = np.empty((2, n_points), scan.xyz.dtype)
        result = Labelled(np.empty(n_points, np.uint8), *numbers)
        labels.label_points(
            # One type also without a point: another would be compiled, for seconds, when it comes.
            scan._replace(xyz=scan.xyz.T),
            faces,
            linear_pieces(surface.knots, surface.mean, scan.xyz.dtype).reshape(-1),
            relief.pieces.reshape(-1).astype(scan.xyz.dtype),
            relief.is_level,
            surface.knots[0],
            numbers_of(config.label),
            highest_ground(height),
            sum_units(n_points),
            number_shift(n_points),
            lowest_of(surface),
            config.label.rule == 'roughness',
            result,
        )
        return result
