"""Loops of `gp_ground_seg.core.pipeline.lines`, compiled."""

from __future__ import annotations

from gp_ground_seg.core.frame import BoolArray, Candidates
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.pipeline import lines

trace = jit(entry=True)(lines.trace)


@jit(entry=True)
def keep_visible(candidates: Candidates, has_occluded_base: BoolArray, kept: Candidates) -> int:
    """Leave out candidates in tiles where the base of a face is occluded; return their number."""
    n = 0
    kept.offsets[0] = 0
    for m in range(len(candidates.offsets) - 1):
        for c in range(candidates.offsets[m], candidates.offsets[m + 1]):
            if not has_occluded_base[candidates.tile[c]]:
                kept.r[n], kept.z[n] = candidates.r[c], candidates.z[c]
                kept.density[n] = candidates.density[c]
                kept.bin[n], kept.tile[n] = candidates.bin[c], candidates.tile[c]
                kept.x[n], kept.y[n] = candidates.x[c], candidates.y[c]
                n += 1
        kept.offsets[m + 1] = n
    return n
