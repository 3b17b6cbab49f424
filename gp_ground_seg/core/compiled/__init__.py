"""The stages of a frame, compiled with numba: a twin of each file by the same name."""

# Their functions are the compiled forms of plain ones.
from gp_ground_seg.core.compiled import evidence, ground, latent, likelihood  # noqa: F401
