"""The passes from ground candidates to lines and pseudo-inputs, compiled, in one call.

From megabytes of points to a few thousand candidates, Python between two passes takes
longer than a pass.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import Candidates, FloatArray, IntArray, Lines, PseudoInputs
from gp_ground_seg.jit import compiled
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.pipeline.hidden_feet import keep_compiled
from gp_ground_seg.pipeline.line_bends import follow_compiled
from gp_ground_seg.pipeline.line_extraction import extract
from gp_ground_seg.pipeline.pseudo_inputs import select_compiled

BoolArray = npt.NDArray[np.bool_]
_TileArray = npt.NDArray[np.int32]
_CandidateFields = tuple[FloatArray, FloatArray, IntArray, FloatArray, IntArray, _TileArray]
_LineFields = tuple[IntArray, FloatArray, IntArray]
_PseudoFields = tuple[FloatArray, IntArray, IntArray, FloatArray]


def find_lines_compiled(
    candidates: Candidates, is_footless: BoolArray, config: Config
) -> tuple[Candidates, Lines, PseudoInputs, BoolArray]:
    """Candidates that show ground, lines through them, pseudo-inputs, and who follows whom.

    Parameters are those of `gp_ground_seg.backend.Backend.find_lines`.
    """
    lines, latent, growth = config.lines, config.latent, config.growth
    kept, found, pseudo, follows = _find_lines(
        is_footless,
        candidates.r,
        candidates.z,
        candidates.bin,
        candidates.density,
        candidates.offsets,
        candidates.tile,
        lines.slope_tolerance,
        lines.offset_tolerance,
        lines.max_line_distance,
        lines.max_gap,
        lines.max_gap_growth,
        lines.max_density_ratio,
        lines.error_ratio,
        latent.candidates_per_pseudo_input,
        latent.medium_extent,
        latent.long_extent,
        latent.sloped_gradient,
        latent.steep_gradient,
        config.length_scale.min,
        config.length_scale.max,
        growth.min_line_size,
        growth.min_bend_extent,
        growth.max_line_slope,
    )
    return Candidates(*kept), Lines(*found), PseudoInputs(*pseudo), follows


@compiled
def _find_lines(
    is_footless: BoolArray,
    all_r: FloatArray,
    all_z: FloatArray,
    all_bin: IntArray,
    all_density: FloatArray,
    all_offsets: IntArray,
    all_tile: _TileArray,
    slope_tolerance: float,
    offset_tolerance: float,
    max_line_distance: float,
    max_gap: float,
    max_gap_growth: float,
    max_density_ratio: float,
    error_ratio: float,
    candidates_per_pseudo_input: float,
    medium_extent: float,
    long_extent: float,
    sloped_gradient: float,
    steep_gradient: float,
    shortest: float,
    longest: float,
    min_line_size: int,
    min_bend_extent: float,
    max_line_slope: float,
) -> tuple[_CandidateFields, _LineFields, _PseudoFields, BoolArray]:
    kept = keep_compiled(is_footless, all_r, all_z, all_bin, all_density, all_offsets, all_tile)
    r, z, _, density, offsets, _ = kept
    lines = extract(
        offsets, r, z, density, slope_tolerance, offset_tolerance, max_line_distance, max_gap,
        max_gap_growth, max_density_ratio, error_ratio,
    )  # fmt: skip
    _, slope, start = lines
    pseudo = select_compiled(
        offsets, r, start, slope, candidates_per_pseudo_input, medium_extent, long_extent,
        sloped_gradient, steep_gradient, shortest, longest,
    )  # fmt: skip
    follows = follow_compiled(
        offsets, r, z, start, slope, offset_tolerance, min_line_size, min_bend_extent,
        max_line_slope,
    )  # fmt: skip
    return kept, lines, pseudo, follows
